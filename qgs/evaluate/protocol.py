"""Evaluation protocols: all settings that influence scores, with a name and a hash."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from qgs.contracts import Metric, SceneSource
from qgs.contracts.schedule import END, at_step
from qgs.data.view_samplers import Span
from qgs.evaluate.plan import EvaluationIndex
from qgs.evaluate.tuning import tuning_loss
from qgs.recipe import Recipe


@dataclass(frozen=True)
class Protocol:
    """Settings of an evaluation. Results are comparable if the hashes of their protocols are equal.

    name: title for people, not hashed. content: all settings that influence the scores of given
        Gaussians. Paths, the device and the renderer's type are left out, because all renderers
        give the same image.
    """

    name: str
    content: Mapping[str, Any]

    @property
    def canonical(self) -> str:
        """The text that is hashed: `content` as JSON with sorted keys and without spaces."""
        # Sorted and without spaces: the hash must not depend on who wrote the mapping.
        return json.dumps(
            self.content, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False
        )

    @property
    def sha256(self) -> str:
        """SHA-256 hash of `canonical` in UTF-8, as hexadecimal digits."""
        return hashlib.sha256(self.canonical.encode()).hexdigest()


def protocol_of(
    recipe: Recipe,
    index: EvaluationIndex | None = None,
    scenes: Sequence[str] = (),
    step: int = END,
) -> Protocol:
    """Return the protocol of evaluating `recipe` on the views that `index` lists.

    Without an index (None), the protocol tells how views are chosen. scenes: names of the scenes,
    used only without an index. step: number of optimiser steps. The protocol has the values of the
    renderer's scheduled options after this step.
    """
    evaluation = recipe.evaluation
    data, views = _data_and_views(recipe, index, scenes)
    tuning = None
    if evaluation.tuning_steps:
        tuning = {
            "what": evaluation.tuning,
            "steps": evaluation.tuning_steps,
            "rate": evaluation.rate,
            "optimizer": "Adam",
            "loss": tuning_loss(recipe).config.model_dump(mode="json"),
        }
    metrics: dict[str, Any] = {}
    for path, chosen in recipe.parts.items():
        metric = chosen.component
        if issubclass(metric, Metric):
            options = chosen.config.model_dump(mode="json", exclude=set(metric.not_in_protocol))
            metrics[path[-1]] = {"type": chosen.type, "definition": metric.definition, **options}
    # Options without effect are left out: they must not part equal protocols.
    shown = {"frame", "scale"}
    if recipe.views.scale not in ("auto", "search"):
        shown.add("scale_factor")
    poses = recipe.views.model_dump(include=shown)
    if recipe.views.pose_noise:
        poses["noise"] = [recipe.views.pose_noise, evaluation.seed]
    # All renderers give the same image, so its type is left out and its options count.
    renderer = recipe.parts["model", "renderer"]
    content = {
        "format": 1,
        "image_size": recipe.tree["data"]["image_size"],
        "crop": "centre crop to the aspect ratio of image_size, then Lanczos resize",
        "data": data,
        "poses": poses,
        "views": views,
        "renderer": at_step(renderer.config, renderer.schedules, step).model_dump(mode="json"),
        "metrics": metrics,
        "tuning": tuning,
    }
    # The name is for people: it is not part of the hash.
    file = (evaluation.index or "held-out views").replace("\\", "/").rsplit("/", 1)[-1]
    return Protocol(evaluation.protocol or file.removesuffix(".json"), content)


def _data_and_views(
    recipe: Recipe, index: EvaluationIndex | None, scenes: Sequence[str]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return two parts of a protocol: settings of the data, and settings of the scored views.

    With an index, the type of the data source, its split, and options at their defaults are left
    out, so that a data set stored in two formats has the same protocol.
    """
    part = recipe.parts["data",]
    source = part.component
    assert issubclass(source, SceneSource)
    # The size is there at the top level, for all kinds of data.
    left_out = {"image_size", *source.not_in_protocol}
    if index is not None:
        # An index names scenes and frames itself, whatever the split.
        left_out |= source.split_options
        data = part.config.model_dump(mode="json", exclude=left_out, exclude_defaults=True)
        entries = {name: entry.model_dump() if entry else None for name, entry in index.items()}
        return data, {"index": entries}
    data = {"type": part.type, **part.config.model_dump(mode="json", exclude=left_out)}
    drawn = recipe.views.model_dump(mode="json", include={"inputs", "targets", "gap"})
    drawn |= recipe.evaluation.model_dump(include={"scenes", "samples", "seed"})
    drawn["names"] = scenes
    # The default sampler is what `gap` says; any other one draws other views.
    sampler = recipe.parts["view_sampler",]
    if sampler.options != Span.Config().model_dump() or sampler.type != "qgs/span":
        drawn["sampler"] = {"type": sampler.type, **sampler.options}
    return data, {"drawn": drawn}
