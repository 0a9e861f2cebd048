"""Scores of an evaluation: by scene, their means, files and tables."""

import csv
import io
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from qgs.contracts import Column
from qgs.data.samples import Frames
from qgs.evaluate.plan import GIVEN, SceneFailure, given_targets
from qgs.evaluate.protocol import Protocol
from qgs.files import write_text
from qgs.metrics.baselines import BASELINES
from qgs.metrics.dispersion import OPACITY_USED
from qgs.wording import counted, listed, numbered

METHODS = ("model", *BASELINES)
TUNING = {"tuning_loss_before": "loss_before", "tuning_loss_after": "loss_after"}
"""Values of a tuned scene, and how the record of its tuning calls them."""


def spread(values: Sequence[float]) -> dict[str, float]:
    """Return mean, variance (over the population) and median of a value over scenes."""
    found = {"mean": np.mean(values), "variance": np.var(values), "median": np.median(values)}
    return {name: float(value) for name, value in found.items()}


@dataclass(frozen=True)
class SceneScore:
    """One scene. views: input and target frames of each of its samples; names: as in `Sample`.

    values: means over the samples of METHOD_METRIC, "gaussians_used", of tuned scenes TUNING; less
    those whose metric needs what the method or the scene lacks.
    """

    scene: str
    views: Sequence[tuple[Frames, Frames]]
    values: Mapping[str, float]
    names: Mapping[int, str] = field(default_factory=dict)

    @property
    def given(self) -> list[int]:
        """Frames that one of the samples has as input and as target."""
        both = [given_targets(*frames) for frames in self.views]
        return sorted(set().union(*both))

    def cells(self) -> dict[str, str | float]:
        """Return what scenes.csv says of it, by column; frames by name where they have any."""
        cells: dict[str, str | float] = {}
        for place, column in enumerate(("input_frames", "target_frames")):
            sides = [[self.names.get(f, str(f)) for f in frames[place]] for frames in self.views]
            cells[column] = "; ".join(map(" ".join, sides))
        return {**cells, **self.values}


@dataclass(frozen=True)
class Evaluation:
    """All scenes and what they amount to; the same weights and recipe give the same numbers.

    columns: by name of the value. scores: of the judged scenes. wanted: names of all scenes of the
    protocol. missing: those without a score. gaussians: of a scene, the most of any.
    incomplete: values that scenes lack, and why. step: optimiser steps behind the weights.
    remarks: sentences on what was judged and what came of it.
    """

    protocol: Protocol
    columns: Mapping[str, Column]
    scores: Sequence[SceneScore]
    wanted: Sequence[str]
    gaussians: int
    missing: Sequence[SceneFailure] = ()
    incomplete: Mapping[str, str] = field(default_factory=dict)
    step: int | None = None
    remarks: Sequence[str] = ()

    def mean(self, metric: str, method: str = "model") -> float | None:
        """Return the mean over scenes of one of `columns`; None if none has this value."""
        values = self._values(f"{method}_{metric}")
        return sum(values) / len(values) if values else None

    def means(self, method: str = "model") -> dict[str, float | None]:
        """Return the `mean` of all `columns`."""
        return {name: self.mean(name, method) for name in self.columns}

    @property
    def statement(self) -> str:
        """The model's first value, usually PSNR, and over how many scenes, in one line."""
        line = f"over {self._of_wanted(len(self.scores))} scene{'s' * (len(self.wanted) != 1)}"
        for name, value in self.means().items():
            if value is not None:
                column = self.columns[name]
                line = f"{column.heading} {column.shown(value)} {line}"
                break
        missing = listed([failure.scene for failure in self.missing])
        return f"{line}; missing: {missing}" if missing else line

    def summary(self) -> dict[str, Any]:
        """Return everything but the scores of single scenes, as plain values for JSON.

        over_scenes: of each value of the model the mean, variance and median over scenes.
        """
        values = {name: self._values(f"model_{name}") for name in self.columns}
        used = spread(self._values("gaussians_used"))["mean"]
        return {
            "protocol": {"name": self.protocol.name, "sha256": self.protocol.sha256},
            "step": self.step,
            "statement": self.statement,
            "scenes": len(self.scores),
            "scenes_in_protocol": len(self.wanted),
            "samples": sum(len(score.views) for score in self.scores),
            "missing": {failure.scene: failure.reason for failure in self.missing},
            "context_and_target": {s.scene: s.given for s in self.scores if s.given},
            "columns": {name: asdict(column) for name, column in self.columns.items()},
            **{method: self.means(method) for method in METHODS},
            "incomplete": dict(self.incomplete),
            "over_scenes": {n: {**spread(v), "scenes": len(v)} for n, v in values.items() if v},
            "gaussians": self.gaussians,
            "gaussians_used": {"opacity_above": OPACITY_USED, "mean": used},
            "tuning": self._tuning(),
            "remarks": list(self.remarks),
        }

    def write(self, folder: str | Path) -> None:
        """Write scenes.csv, summary.json, table.md and protocol.json, each whole or not at all.

        protocol.json is `Protocol.canonical`: its SHA-256 is the protocol's hash.
        """
        table = f"{markdown_table(self._rows())}\n\n{bullets(self._notes())}\n"
        files = {
            "scenes.csv": self._csv(),
            "summary.json": as_json(self.summary()),
            "table.md": table,
            # Last: `qgs train --resume` takes it as the sign of a whole evaluation.
            "protocol.json": self.protocol.canonical,
        }
        for name, text in files.items():
            write_text(Path(folder, name), text)

    def show(self, console: Console) -> None:
        """Print the table and the notes of table.md."""
        print_table(console, str(self.protocol), self._rows())
        print_lines(console, self._notes())

    def _values(self, name: str) -> list[float]:
        return [score.values[name] for score in self.scores if name in score.values]

    def _of_wanted(self, count: int) -> str:
        wanted = len(self.wanted)
        return str(count) if count == wanted else f"{count} of {wanted}"

    def _tuning(self) -> dict[str, Any] | None:
        settings = self.protocol.content["tuning"]
        if settings is None:
            return None
        losses = {key: spread(self._values(name))["mean"] for name, key in TUNING.items()}
        return {**settings, **losses}

    def _rows(self) -> list[list[str]]:
        """Return the means of all methods."""
        judged = self._of_wanted(len(self.scores))
        rows = [["method", *(column.title for column in self.columns.values()), "scenes"]]
        for method in METHODS:
            cells = [self.columns[name].shown(v) for name, v in self.means(method).items()]
            rows.append([method.replace("_", " "), *cells, judged])
        return rows

    def _csv(self) -> str:
        reasons = {failure.scene: failure.reason for failure in self.missing}
        judged = {score.scene: score.cells() for score in self.scores}
        columns = dict.fromkeys(column for cells in judged.values() for column in cells)
        text = io.StringIO()
        writer = csv.DictWriter(text, ["scene", *columns, "problem"], lineterminator="\n")
        writer.writeheader()
        # Every wanted scene has a row, so that a missing one shows in the file.
        for name in self.wanted:
            row = {"scene": name, "problem": reasons.get(name, "")}
            writer.writerow(row | judged.get(name, {}))
        return text.getvalue()

    def _notes(self) -> Iterator[str]:
        """Yield what table.md says below the table, a line each."""
        yield self.statement
        content = self.protocol.content
        height, width = content["image_size"]
        counts = sorted({len(inputs) for score in self.scores for inputs, _ in score.views})
        poses = content["poses"]
        yield (
            f"protocol {self.protocol.name}, sha256 {self.protocol.sha256}: "
            f"{' or '.join(map(str, counts))} input views of {width} x {height} pixels, poses "
            f"{poses['frame']}, scale {poses['scale']} {poses.get('scale_factor', '')}".rstrip()
        )
        # A broken data set would bury the table; scenes.csv has every reason.
        yield from (f"missing {f.scene}: {f.reason}" for f in self.missing[:10])
        if given := [score for score in self.scores if score.given]:
            named = [
                f"{s.scene} ({listed(numbered(f, s.names.get(f, '')) for f in s.given)})"
                for s in given
            ]
            yield (
                f"{counted(len(given), 'scene')} with {GIVEN}, on which the "
                f"nearest input view is perfect: {listed(named)}"
            )
        for name, why in self.incomplete.items():
            count = len(self._values(f"model_{name}"))
            over = f"over {self._of_wanted(count)} scenes" if count else "empty"
            yield f"{self.columns[name].heading} is {over}: {why}"
        used = spread(self._values("gaussians_used"))["mean"]
        yield (
            f"{self.gaussians:,} Gaussians a scene, {used:,.0f} of them used (opacity above "
            f"{OPACITY_USED:.4f}; mean over scenes)"
        )
        if tuning := self._tuning():
            yield "{what} tuned on the input views: {steps} steps of Adam at {rate}".format(
                **tuning
            )
        yield from self.remarks


def as_json(value: Mapping[str, Any]) -> str:
    """Return a file's text; raises ValueError for NaN and infinities."""
    return json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def markdown_table(rows: Sequence[Sequence[str]]) -> str:
    """Return rows of equal length, headers first, as a Markdown table; numbers to the right."""
    rule = [":---", *["---:"] * (len(rows[0]) - 1)]
    lines = [[cell.replace("|", "\\|") for cell in row] for row in (rows[0], rule, *rows[1:])]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def bullets(lines: Iterable[str]) -> str:
    """Return lines as a Markdown list."""
    return "\n".join(f"- {line}" for line in lines)


def print_table(
    console: Console, title: str, rows: Sequence[Sequence[str]], **options: Any
) -> None:
    """Print rows, headers first; numbers to the right. options: of rich's Table."""
    table = Table(title=escape(title) or None, title_justify="left", **options)
    for place, header in enumerate(rows[0]):
        table.add_column(header, justify="right" if place else "left", overflow="fold")
    for row in rows[1:]:
        table.add_row(*row)
    console.print(table)


def print_lines(console: Console, lines: Iterable[str]) -> None:
    """Print lines of plain text."""
    for line in lines:
        console.print(escape(line), highlight=False, soft_wrap=True)
