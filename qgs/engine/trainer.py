"""The training loop."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import torch
from accelerate import Accelerator
from rich.console import Console
from torch import Tensor

from qgs.composer import Recipe
from qgs.data.loader import training_batches
from qgs.data.sampling import Batch
from qgs.engine.collapse import (
    REMEDIES,
    CollapseDetector,
    CollapseError,
    GoodWeights,
    Vitals,
    measure,
    not_finite,
)
from qgs.engine.folder import RunFolder
from qgs.engine.interrupt import StopRequest, stop_requests
from qgs.engine.objective import Objective, Outcome
from qgs.engine.optimizer import make_optimizer
from qgs.engine.progress import TrainingProgress
from qgs.engine.schedule import OneCycle
from qgs.engine.seeds import set_seed
from qgs.io.checkpoint import save
from qgs.metrics import psnr
from qgs.model import QueryGaussianModel


@dataclass(frozen=True)
class TrainingResult:
    """What a run left: the trained model, its folder, optimiser steps, seconds on the clock.

    stopped_by: name of the signal that ended it early, else None.
    """

    model: QueryGaussianModel
    folder: RunFolder
    steps: int
    seconds: float
    stopped_by: str | None


def train(recipe: Recipe, run: str | Path, *, console: Console | None = None) -> TrainingResult:
    """Train the model of `recipe` and leave everything in the folder `run`.

    Writes recipe.yaml, history.jsonl (one record per optimiser step) and checkpoint.safetensors: on
    schedule, at the end, and after SIGINT or SIGTERM, which finish the step and return. The clock
    of `training.seconds` starts after the first step, in which kernels compile.

    Raises FileExistsError when `run` holds anything, and CollapseError when the model died; the
    checkpoint then holds the last good weights.
    """
    folder = RunFolder.create(run)
    folder.write_recipe(recipe)
    set_seed(recipe.seed)
    trainer = Trainer(recipe, folder)
    try:
        with TrainingProgress(console or Console(stderr=True)) as progress, stop_requests() as stop:
            return trainer.run(progress, stop)
    finally:
        folder.close()


class Trainer:
    """The state of one run: model, optimiser, clock, detector."""

    def __init__(self, recipe: Recipe, folder: RunFolder) -> None:
        self.config = recipe.training
        self.folder = folder
        self.accelerator = Accelerator(cpu=not torch.cuda.is_available(), mixed_precision="no")
        self.device = self.accelerator.device
        self.model = recipe.build_model(device=self.device).train()
        self._batches = self._stream(recipe)
        objective = Objective(self.model, recipe.build_losses()).to(self.device)
        self.objective, self.optimizer = self.accelerator.prepare(
            objective, make_optimizer(objective, self.config)
        )
        self.schedule = OneCycle(self.config)
        self.detector = CollapseDetector(self.config.collapse_window)
        self.good = GoodWeights(self.model)
        self.background = torch.tensor(self.model.renderer.config.background, device=self.device)
        self.step = 0
        self.images = 0
        self.seconds = 0.0
        self._clock_started: float | None = None

    def run(self, progress: TrainingProgress, stop: StopRequest) -> TrainingResult:
        """Train until the budget is used, a stop is asked for, or the model dies."""
        while self.used < 1:
            record = self._optimise(stop)
            self.folder.append(record)
            shown = progress.update(
                self.step, record["loss"], record["psnr"], self.images, self.seconds, self.used
            )
            if shown:
                self.folder.flush()
            if self.detector.collapsed:
                self._give_up(f"for {self.detector.dead_steps} steps {self.detector.symptom}")
            self._keep_good_weights()
            if record["stop"]:
                break
        self._finish(stop)
        name = stop.signal.name if stop.signal else None
        return TrainingResult(self.model.eval(), self.folder, self.step, self.seconds, name)

    @property
    def used(self) -> float:
        """Fraction of the budget that is used, the larger of steps and seconds."""
        of_steps = self.step / self.config.steps
        of_seconds = self.seconds / self.config.seconds if self.config.seconds else 0.0
        return max(of_steps, of_seconds)

    def _stream(self, recipe: Recipe) -> Iterator[Batch]:
        rank = self.accelerator.process_index
        seed = recipe.seed + 1_000_003 * rank
        return iter(
            training_batches(recipe.build_data(), recipe.views, self.config.batch_size, seed)
        )

    def _optimise(self, stop: StopRequest) -> dict[str, float]:
        """One optimiser step; returns its record for the history."""
        rate = self.schedule.rate(self.step, self.seconds)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.optimizer.zero_grad(set_to_none=True)
        measured = self._backward()
        norm = self.accelerator.clip_grad_norm_(self.objective.parameters(), self.config.clip)
        measured["gradient"] = torch.as_tensor(norm, device=self.device).detach()
        record = self._read(measured, stop)
        self._refuse_nonfinite(record)
        self.optimizer.step()
        self.detector.observe(
            Vitals(record.pop("alpha"), record.pop("deviation"), record["gradient"])
        )
        self.step += 1
        self._tick()
        return {"step": self.step, "seconds": self.seconds, "lr": rate, **record}

    def _backward(self) -> dict[str, Tensor]:
        """Gradients of `accumulate` batches; what was measured, as 0-d tensors averaged over them.

        Only the last batch exchanges gradients between processes.
        """
        count = self.config.accumulate
        sums: dict[str, Tensor] = {}
        for index in range(count):
            batch = next(self._batches)
            inputs, targets = batch.inputs.to(self.device), batch.targets.to(self.device)
            last = index == count - 1
            with nullcontext() if last else self.accelerator.no_sync(self.objective):
                with torch.autocast(
                    self.device.type, torch.bfloat16, enabled=self.config.precision == "bf16"
                ):
                    outcome: Outcome = self.objective(inputs, targets)
                self.accelerator.backward(outcome.total / count)
            self.images += targets.images.shape[:2].numel() * self.accelerator.num_processes
            for name, value in self._measure(outcome, targets.images).items():
                sums[name] = sums.get(name, 0) + value / count
        return sums

    @torch.no_grad()
    def _measure(self, outcome: Outcome, truth: Tensor) -> dict[str, Tensor]:
        rgb = outcome.rendering.rgb
        alpha, deviation = measure(rgb, outcome.rendering.alpha, self.background)
        return {
            "loss": outcome.total.detach(),
            **outcome.terms,
            "psnr": psnr(rgb, truth).mean(),
            "alpha": alpha,
            "deviation": deviation,
        }

    def _read(self, measured: dict[str, Tensor], stop: StopRequest) -> dict[str, float]:
        """Numbers of one step, the mean over processes; the only synchronisation of a step."""
        asked = torch.tensor(float(bool(stop)), device=self.device)
        values = torch.stack([v.float() for v in (*measured.values(), asked)])
        return dict(zip([*measured, "stop"], self._mean(values).tolist(), strict=True))

    def _tick(self) -> None:
        now = time.perf_counter()
        if self._clock_started is None:
            self._clock_started = now
        elapsed = torch.tensor(now - self._clock_started, device=self.device)
        self.seconds = float(self._mean(elapsed))

    def _mean(self, value: Tensor) -> Tensor:
        """Mean over processes, so that all of them decide alike."""
        reduced = self.accelerator.reduce(value, "mean")
        assert isinstance(reduced, Tensor)
        return reduced

    def _refuse_nonfinite(self, record: dict[str, float]) -> None:
        terms = {k: v for k, v in record.items() if k not in ("gradient", "stop", "psnr")}
        problem = not_finite(terms, self.model, record["gradient"])
        if problem:
            self._give_up(problem)

    def _keep_good_weights(self) -> None:
        if self.detector.dead_steps:
            return
        if self.step % self.config.collapse_window == 0:
            self.good.refresh(self.step)
        if self.config.save_every and self.step % self.config.save_every == 0:
            self._save()

    def _finish(self, stop: StopRequest) -> None:
        if not self.detector.dead_steps:
            self._save()
        elif stop:
            self._save_good()
        else:
            self._give_up(f"for the last {self.detector.dead_steps} steps {self.detector.symptom}")

    def _give_up(self, problem: str) -> None:
        self._save_good()
        remedies = "".join(f"\n  - {remedy}" for remedy in REMEDIES)
        raise CollapseError(
            f"training collapsed at step {self.step}: {problem}. The weights of step "
            f"{self.good.step} are kept in {self.folder.checkpoint}. Likely causes:{remedies}"
        )

    def _save(self) -> None:
        if self.accelerator.is_main_process:
            save(self.model, self.folder.checkpoint, extra={"step": str(self.step)})

    def _save_good(self) -> None:
        if self.accelerator.is_main_process:
            save(
                self.model,
                self.folder.checkpoint,
                extra={"step": str(self.good.step)},
                weights=self.good.tensors,
            )
