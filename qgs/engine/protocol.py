"""Evaluation protocols: exactly what decides the numbers, named and hashed."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from qgs.composer import Recipe
from qgs.contracts import SceneSourceConfig
from qgs.data.evaluation import EvaluationIndex, read_index
from qgs.engine.tuning import tuning_loss
from qgs.metrics.images import IMAGE_METRICS

_CROP = "centre crop to the aspect ratio of image_size, then Lanczos resize"


@dataclass(frozen=True)
class Protocol:
    """Settings of an evaluation under a name; results with one hash are comparable.

    content: everything that decides a score of given Gaussians, and nothing else: no path, no name
    of a file. That is the data's images and cameras, which views are judged, their poses, the
    metrics, tuning, and the settings that every renderer obeys; not the renderer's type, as all of
    them render alike, on whichever device. `canonical` is its JSON with sorted keys and no
    spaces, `sha256` the hash of that.
    """

    name: str
    content: Mapping[str, Any]

    @property
    def canonical(self) -> str:
        """What is hashed."""
        return canonical_json(self.content)

    @property
    def sha256(self) -> str:
        """Hash of `canonical` in UTF-8, hexadecimal."""
        return _sha256(self.canonical)

    def __str__(self) -> str:
        return f"{self.name} ({self.sha256[:12]})"

    def settings(self) -> dict[str, Any]:
        """`content` with the index, which may be long, told by its size and hash."""
        index = self.content["views"].get("index")
        if index is None:
            return dict(self.content)
        short = {"scenes": len(index), "sha256": _sha256(canonical_json(index))}
        return {**self.content, "views": {"index": short}}


def index_of(recipe: Recipe) -> EvaluationIndex | None:
    """The index that `recipe` names, None where views are drawn. Raises as `read_index`."""
    return read_index(recipe.evaluation.index) if recipe.evaluation.index else None


def protocol_of(
    recipe: Recipe, index: EvaluationIndex | None = None, scenes: Sequence[str] = ()
) -> Protocol:
    """The protocol of `recipe` on the views of `index`, or on views drawn from `scenes`.

    With an index the kind of data, how it is split, and options at their defaults say nothing, so
    that one data set in two formats has one protocol.
    """
    config = recipe.parts["data",].config
    assert isinstance(config, SceneSourceConfig)
    left_out = config.unhashed_options | (config.split_options if index is not None else set())
    options = config.model_dump(
        mode="json",
        exclude={"image_size", *left_out},
        exclude_defaults=index is not None,
    )
    evaluation = recipe.evaluation
    content = {
        "format": 1,
        "image_size": list(config.image_size),
        "crop": _CROP,
        "data": options if index is not None else {"type": recipe.tree["data"]["type"], **options},
        "poses": recipe.views.model_dump(include={"frame", "scale", "scale_factor"}),
        "views": _indexed(index) if index is not None else _drawn(recipe, scenes),
        "renderer": recipe.parts["model", "renderer"].config.model_dump(mode="json"),
        "metrics": {m: IMAGE_METRICS[m] for m in ("psnr", "ssim", *evaluation.metrics)},
        "ssim_covariance": evaluation.ssim_covariance,
        "tuning": _tuning(recipe),
    }
    return Protocol(evaluation.protocol or _name(evaluation.index), content)


def canonical_json(value: Any) -> str:
    """JSON with sorted keys and no spaces."""
    return json.dumps(
        value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False
    )


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _name(index: str | None) -> str:
    return index.replace("\\", "/").rsplit("/", 1)[-1].removesuffix(".json") if index else "drawn"


def _indexed(index: EvaluationIndex) -> dict[str, Any]:
    return {"index": {name: entry.model_dump() if entry else None for name, entry in index.items()}}


def _drawn(recipe: Recipe, scenes: Sequence[str]) -> dict[str, Any]:
    views = recipe.views.model_dump(mode="json", include={"inputs", "targets", "gap"})
    rule = recipe.evaluation.model_dump(include={"scenes", "samples", "seed"})
    return {"drawn": {**views, **rule, "names": list(scenes)}}


def _tuning(recipe: Recipe) -> dict[str, Any] | None:
    evaluation = recipe.evaluation
    if not evaluation.tuning_steps:
        return None
    return {
        "steps": evaluation.tuning_steps,
        "rate": evaluation.tuning_rate,
        "optimizer": "Adam",
        "loss": tuning_loss(recipe).config.model_dump(mode="json"),
    }
