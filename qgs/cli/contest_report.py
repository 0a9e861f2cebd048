"""What the report of a contest shows: figures, unseen scenes with their true depth, facts."""

from __future__ import annotations

import os
import platform
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from qgs.analysis.report import Report
from qgs.cli.contest import Entry, baselines
from qgs.composer import Recipe
from qgs.contracts import SceneSource
from qgs.data.loader import evaluation_samples
from qgs.data.sampling import Sample
from qgs.io.ply import write_ply

PICTURED_SCENES = 3


def report_of(entries: Sequence[Entry], seconds: float, seed: int) -> Report:
    """The comparison, pictured on the first test scenes."""
    recipe = entries[0].recipe
    few = recipe.evaluation.model_copy(update={"scenes": PICTURED_SCENES, "samples": 1})
    source = recipe.build_data()
    samples = evaluation_samples(source, recipe.views, few)[:PICTURED_SCENES]
    names = [entry.contender.name for entry in entries]
    return Report(
        title=" and ".join(names) + f", {seconds:g} seconds of training each",
        contenders=[entry.contender for entry in entries],
        baselines=baselines(entries[0]),
        samples=samples,
        depths=[true_depth(source, sample) for sample in samples],
        facts=_facts([entry.recipe for entry in entries], seconds, seed),
    )


def true_depth(source: SceneSource, sample: Sample) -> Tensor | None:
    """Depth (T, 1, H, W) of the targets in the sample's units; None where the scene has none."""
    scene = next(scene for scene in source.scenes("test") if scene.name == sample.scene)
    depth = scene.depths(sample.target_frames)
    if depth is None:
        return None
    frames = [sample.input_frames[0], *sample.target_frames]
    own = scene.cameras[frames].c2w[:, :3, 3]
    cameras = sample.inputs.cameras.c2w[0, :1], sample.targets.cameras.c2w[0]
    return depth * float(_extent(torch.cat(cameras)[:, :3, 3]) / _extent(own))


def _extent(centres: Tensor) -> Tensor:
    return (centres - centres[0]).norm(dim=-1).amax()


@torch.no_grad()
def write_examples(report: Report, target: Path) -> None:
    """The first pictured scene as TARGET/NAME/example.ply, by every contender."""
    for contender in report.contenders:
        gaussians = contender.model(report.samples[0].inputs).gaussians
        write_ply(gaussians, target / contender.name / "example.ply")


def _facts(recipes: Sequence[Recipe], seconds: float, seed: int) -> dict[str, str]:
    data, views = recipes[0].tree["data"], recipes[0].views
    height, width = data["image_size"]
    plugins = {name: version for r in recipes for name, version in r.plugin_versions.items()}
    versions = [f"{name} {version}" for name, version in plugins.items()]
    return {
        "Data": f"{data['type']}, {width} × {height} pixels",
        "Views": f"{views.inputs} inputs, judged on the views between them",
        "Budget": f"{seconds:g} seconds of training each, seed {seed}",
        "Machine": f"{_device()}, {torch.get_num_threads()} threads, {platform.system()}",
        "Software": ", ".join([f"torch {torch.__version__}", *versions]),
    }


def _device() -> str:
    if torch.cuda.is_available():
        return torch.cuda.get_device_name()
    return f"CPU with {os.cpu_count()} cores ({platform.machine()})"
