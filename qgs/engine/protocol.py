"""Evaluation protocols: exactly what decides the numbers, named and hashed."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from qgs.composer import Recipe
from qgs.contracts import Metric, SceneSourceConfig
from qgs.data.evaluation import EvaluationIndex, read_index
from qgs.engine.tuning import tuning_loss

_CROP = "centre crop to the aspect ratio of image_size, then Lanczos resize"


@dataclass(frozen=True)
class Protocol:
    """Settings of an evaluation under a name; results with one hash are comparable.

    content: everything that decides a score of given Gaussians, and nothing else: no path, no name
    of a file. That is the data's images and cameras, which views are judged, their poses, the
    metrics, tuning, and the settings that every renderer obeys; not the renderer's type, as all of
    them render alike, on whichever device.
    """

    name: str
    content: Mapping[str, Any]

    @property
    def canonical(self) -> str:
        """What is hashed: `content` as JSON with sorted keys and no spaces."""
        return canonical_json(self.content)

    @property
    def sha256(self) -> str:
        """Hash of `canonical` in UTF-8, hexadecimal."""
        return _sha256(self.content)

    def __str__(self) -> str:
        return f"{self.name} ({self.sha256[:12]})"

    def settings(self) -> dict[str, Any]:
        """`content` with size and hash in place of the index, which may be long."""
        index = self.content["views"].get("index")
        if index is None:
            return dict(self.content)
        return {
            **self.content,
            "views": {"index": {"scenes": len(index), "sha256": _sha256(index)}},
        }


def index_of(recipe: Recipe) -> EvaluationIndex | None:
    """The index that `recipe` names, None where views are drawn. Raises as `read_index`."""
    return read_index(recipe.evaluation.index) if recipe.evaluation.index else None


def protocol_of(
    recipe: Recipe, index: EvaluationIndex | None = None, scenes: Sequence[str] = ()
) -> Protocol:
    """The protocol of `recipe` on the views of `index`, or on views drawn from `scenes`.

    With an index the kind of data, how it is split, and options at their defaults are left out, so
    that one data set in two formats has one protocol.
    """
    evaluation, config = recipe.evaluation, recipe.parts["data",].config
    assert isinstance(config, SceneSourceConfig)
    left_out = {"image_size", *config.unhashed_options}
    data: dict[str, Any] = {}
    if index is None:
        data["type"] = recipe.tree["data"]["type"]
        views = recipe.views.model_dump(mode="json", include={"inputs", "targets", "gap"})
        rule = evaluation.model_dump(include={"scenes", "samples", "seed"})
        judged: dict[str, Any] = {"drawn": {**views, **rule, "names": list(scenes)}}
    else:
        left_out |= config.split_options
        judged = {"index": {n: entry.model_dump() if entry else None for n, entry in index.items()}}
    data |= config.model_dump(mode="json", exclude=left_out, exclude_defaults=index is not None)
    tuning = None
    if evaluation.tuning_steps:
        loss = tuning_loss(recipe).config.model_dump(mode="json")
        budget = {"steps": evaluation.tuning_steps, "rate": evaluation.tuning_rate}
        tuning = {**budget, "optimizer": "Adam", "loss": loss}
    content = {
        "format": 2,
        "image_size": list(config.image_size),
        "crop": _CROP,
        "data": data,
        "poses": recipe.views.model_dump(include={"frame", "scale", "scale_factor"}),
        "views": judged,
        "renderer": recipe.parts["model", "renderer"].config.model_dump(mode="json"),
        "metrics": _metrics(recipe),
        "tuning": tuning,
    }
    file = (evaluation.index or "drawn").replace("\\", "/").rsplit("/", 1)[-1]
    return Protocol(evaluation.protocol or file.removesuffix(".json"), content)


def canonical_json(value: Any) -> str:
    """JSON with sorted keys and no spaces."""
    return json.dumps(
        value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False
    )


def _sha256(value: Any) -> str:
    return hashlib.sha256(canonical_json(value).encode()).hexdigest()


def _metrics(recipe: Recipe) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for path, chosen in recipe.parts.items():
        metric = chosen.component
        if path[0] == "metrics" and issubclass(metric, Metric):
            options = chosen.config.model_dump(mode="json", exclude=set(metric.not_in_protocol))
            found[path[1]] = {"type": chosen.type, "definition": metric.definition, **options}
    return found
