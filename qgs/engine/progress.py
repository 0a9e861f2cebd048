"""What a person sees while a model trains."""

from __future__ import annotations

import time
from datetime import timedelta

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

_REFRESH_SECONDS = 0.25
_LOG_SECONDS = 15.0


class TrainingProgress:
    """A bar with loss, PSNR, images/s and time left; a line now and then where no terminal is."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._bar = Progress(
            TextColumn("step {task.fields[step]}"),
            BarColumn(),
            TextColumn("{task.fields[line]}"),
            console=console,
            auto_refresh=False,
            transient=True,
        )
        self._task = self._bar.add_task("training", total=1.0, step=0, line="")
        self._next = 0.0
        self._start: tuple[int, float, float] | None = None
        self._interval = _REFRESH_SECONDS if console.is_terminal else _LOG_SECONDS

    def __enter__(self) -> TrainingProgress:
        if self._console.is_terminal:
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def update(
        self, step: int, loss: float, psnr: float, images: int, seconds: float, used: float
    ) -> bool:
        """Show a step, unless the last one was shown a moment ago; returns whether it did.

        images, seconds: of the whole run so far. used: fraction of the budget. Speed and time left
        are those of this session, which began with the first step that this is told.
        """
        if self._start is None:
            self._start = images, seconds, used
        now = time.monotonic()
        if now < self._next:
            return False
        self._next = now + self._interval
        done, spent = images - self._start[0], seconds - self._start[1]
        gained = used - self._start[2]
        rate = done / spent if spent else 0.0
        left = str(timedelta(seconds=round(spent * (1 - used) / gained))) if gained else "?"
        line = f"loss {loss:.4f}  PSNR {psnr:5.2f}  {rate:.0f} images/s  {left} left"
        if self._console.is_terminal:
            self._bar.update(self._task, completed=used, step=step, line=line, refresh=True)
        else:
            self._console.print(f"step {step}  {line}", highlight=False)
        return True
