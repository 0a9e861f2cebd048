"""Steps whose loss or gradient was not finite: found, saved, and counted."""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from accelerate import Accelerator
from accelerate.utils import gather_object
from safetensors import safe_open
from torch import Tensor, nn

from qgs.data.sampling import Batch
from qgs.engine.checkpoint import Weights
from qgs.engine.distributed import whole
from qgs.engine.objective import Gradients, Objective
from qgs.io.checkpoint import save, unique_tensors, write_tensors
from qgs.io.files import replacing_entries
from qgs.types import Cameras, Views, named_tensors


@dataclass(frozen=True)
class Finding:
    """A tensor with NaN or infinity. batch: which of the step's batches it came up in, from 0."""

    tensor: str
    values: str
    batch: int

    def __str__(self) -> str:
        return f"{self.tensor} ({self.values})"


class Watch:
    """Notes the first tensor that is not finite, in the order in which a step computes.

    That is: weights, images and cameras, outputs of the model's modules, and then, layer by layer,
    what is predicted, the renderings, the loss terms and the gradients of the Gaussians; last the
    gradients of the modules' outputs and of the parameters, backwards.
    """

    def __init__(self) -> None:
        self.first: Finding | None = None
        self._batch = -1
        self._calls: Counter[str] = Counter()

    def see(self, name: str, value: Any) -> None:
        """Look at `value`: a tensor, or any nest of mappings, sequences and containers of them."""
        if self.first:
            return
        for path, tensor in named_tensors(value, name):
            described = described_nonfinite(tensor)
            if described:
                self.first = Finding(path, described, max(self._batch, 0))
                return

    @contextmanager
    def on(self, objective: Objective) -> Iterator[None]:
        """Watch the steps that `objective` makes inside the `with` block."""
        for name, tensor in unique_tensors(objective).items():
            self.see(f"weight {name}", whole(tensor))
        handles = [objective.register_forward_pre_hook(self._see_batch)]
        for name, module in objective.named_modules():
            if name.startswith("model.") and module is not objective.model.renderer:
                hook = partial(self._see_output, name)
                handles.append(module.register_forward_hook(hook))
        for name, parameter in objective.named_parameters():
            if parameter.requires_grad:
                hook = partial(self.see, f"gradient of {name}")
                handles.append(parameter.register_hook(hook))
        observe, objective.observe = objective.observe, self.see
        try:
            yield
        finally:
            objective.observe = observe
            for handle in handles:
                handle.remove()

    def _see_batch(self, module: nn.Module, arguments: tuple[Any, ...]) -> None:
        self._batch += 1
        self._calls.clear()
        for name, views in zip(("inputs", "targets"), arguments, strict=True):
            self.see(name, views)

    def _see_output(self, name: str, module: nn.Module, arguments: Any, output: Any) -> None:
        self._calls[name] += 1
        call = f" (call {self._calls[name]})" if self._calls[name] > 1 else ""
        what = f"output{call} of {name}"
        self.see(what, output)
        for path, tensor in named_tensors(output, f"gradient of the {what}"):
            if tensor.requires_grad:
                tensor.register_hook(partial(self.see, path))


def described_nonfinite(tensor: Tensor) -> str:
    """How many values of `tensor` are NaN and infinite; "" if none is."""
    tensor = tensor.detach()
    if not tensor.is_floating_point() or bool(torch.isfinite(tensor).all()):
        return ""
    nan, infinite = int(torch.isnan(tensor).sum()), int(torch.isinf(tensor).sum())
    counts = [f"{n} {word}" for n, word in ((nan, "NaN"), (infinite, "infinite")) if n]
    return f"{' and '.join(counts)} of {tensor.numel()} values"


PATIENCE = 10


"""Steps in a row that may be skipped; after them training stops."""


KEPT = 20


"""Incidents of a run that are saved; later ones are told and counted."""


@dataclass(frozen=True)
class Incident:
    """What was found of a bad step, in words. in_data: whether it came with the images and cameras
    of a batch, and so from nothing that the model did."""

    words: str
    in_data: bool

    def __str__(self) -> str:
        return self.words


class Incidents:
    """Looks into steps that went wrong, with the objective and the batches of that step.

    An incident's folder holds batch.safetensors (of another process than the main one
    batch-RANK.safetensors, where it found something), weights.safetensors, which `qgs.load` reads,
    and report.json.
    """

    def __init__(
        self, accelerator: Accelerator, objective: Objective, gradients: Gradients, folder: Path
    ) -> None:
        """objective: as it was before `Accelerator.prepare` wrapped it."""
        self.total = 0
        self.in_a_row = 0
        self._accelerator = accelerator
        self._objective = objective
        self._gradients = gradients
        self._folder = folder

    def passed(self) -> None:
        """Take note of a step that was fine."""
        self.in_a_row = 0

    def look_into(self, step: int, batches: Sequence[Batch], symptom: str) -> Incident:
        """Find the first bad tensor of a step and save what it takes to see it again.

        symptom: what the step showed. All processes must call this; gradients are those of the
        repeated step afterwards.
        """
        self.total += 1
        self.in_a_row += 1
        watch = Watch()
        with watch.on(self._objective):
            self._gradients.compute(batches)
        own = {"process": self._accelerator.process_index, **_report_of(watch.first, batches)}
        reports = self._gathered(own)
        found = [report for report in reports if report["first"]]
        words = f"{symptom}; {_in_words(found)}"
        in_data = bool(found) and all(_is_data(report["first"]["tensor"]) for report in found)
        if self.total > KEPT:
            return Incident(f"{words}; not saved, as {KEPT} incidents of this run are", in_data)
        place = self._save(step, batches, {"step": step, "symptom": symptom, "found": reports}, own)
        return Incident(f"{words}; batch and weights are in {place}", in_data)

    def state(self) -> dict[str, int]:
        """See `qgs.engine.checkpoint.Stateful`."""
        return {"total": self.total, "in_a_row": self.in_a_row}

    def load_state(self, state: Mapping[str, Any]) -> None:
        """See `qgs.engine.checkpoint.Stateful`."""
        self.total, self.in_a_row = state["total"], state["in_a_row"]

    def _gathered(self, report: dict[str, Any]) -> list[dict[str, Any]]:
        return gather_object([report]) if self._accelerator.num_processes > 1 else [report]

    def _save(
        self, step: int, batches: Sequence[Batch], report: Mapping[str, Any], own: Mapping[str, Any]
    ) -> Path:
        name = f"step-{step}"
        place = self._folder / "incidents" / name
        weights = Weights(self._objective.model).state()
        if self._accelerator.is_main_process:
            with replacing_entries(place.parent) as fresh:
                write_batches(fresh / name / "batch.safetensors", batches)
                extra = {"step": str(step - 1)}
                path = fresh / name / "weights.safetensors"
                save(self._objective.model, path, extra=extra, weights=weights)
                text = json.dumps(report, indent=2) + "\n"
                (fresh / name / "report.json").write_text(text, encoding="utf-8")
        self._accelerator.wait_for_everyone()
        if own["first"] and not self._accelerator.is_main_process:
            write_batches(place / f"batch-{own['process']}.safetensors", batches)
        self._accelerator.wait_for_everyone()
        return place


def write_batches(path: str | os.PathLike[str], batches: Sequence[Batch]) -> None:
    """Write batches of one shape, one after the other, as a safetensors file."""
    tensors: dict[str, Tensor] = {}
    for side in ("inputs", "targets"):
        views: list[Views] = [getattr(batch, side) for batch in batches]
        tensors[f"{side}.images"] = torch.cat([v.images for v in views])
        tensors[f"{side}.c2w"] = torch.cat([v.cameras.c2w for v in views])
        tensors[f"{side}.intrinsics"] = torch.cat([v.cameras.intrinsics for v in views])
        masks = [v.masks for v in views if v.masks is not None]
        if masks:
            tensors[f"{side}.masks"] = torch.cat(masks)
    shown = {
        name: json.dumps([item for batch in batches for item in getattr(batch, name)])
        for name in ("scenes", "input_frames", "target_frames")
    }
    write_tensors(path, tensors, shown)


def read_batch(path: str | os.PathLike[str]) -> Batch:
    """The batches of an incident as one."""
    with safe_open(path, "pt") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        shown = {name: json.loads(text) for name, text in file.metadata().items()}

    def views(side: str) -> Views:
        images = tensors[f"{side}.images"]
        height, width = images.shape[-2:]
        cameras = Cameras(tensors[f"{side}.c2w"], tensors[f"{side}.intrinsics"], (height, width))
        return Views(images, cameras, tensors.get(f"{side}.masks"))

    return Batch(
        views("inputs"),
        views("targets"),
        tuple(shown["scenes"]),
        tuple(map(tuple, shown["input_frames"])),
        tuple(map(tuple, shown["target_frames"])),
    )


def _report_of(first: Finding | None, batches: Sequence[Batch]) -> dict[str, Any]:
    """What one process knows: its first bad tensor, and what each of its batches shows."""
    return {
        "first": asdict(first) if first else None,
        "batches": [
            {
                "scenes": batch.scenes,
                "input_frames": batch.input_frames,
                "target_frames": batch.target_frames,
            }
            for batch in batches
        ],
    }


def _is_data(tensor: str) -> bool:
    return tensor.startswith(("inputs.", "targets."))


def _in_words(found: Sequence[Mapping[str, Any]]) -> str:
    """The first bad tensors of processes, each with the batch that it came up in."""
    if not found:
        return "repeating the step gave finite numbers everywhere"
    sentences = []
    for report in found:
        finding = Finding(**report["first"])
        shown = report["batches"][finding.batch]
        samples = zip(shown["scenes"], shown["input_frames"], shown["target_frames"], strict=True)
        listed = ", ".join(
            f"scene {scene!r} (inputs {list(inputs)}, targets {list(targets)})"
            for scene, inputs, targets in samples
        )
        sentences.append(f"the first bad tensor is {finding}, with {listed}")
    return "; ".join(sentences)
