"""What an evaluation amounts to: scores by scene, their means, and the scenes that lack one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from qgs.data.evaluation import SceneFailure
from qgs.data.index import given_targets
from qgs.data.sampling import Frames
from qgs.engine import results
from qgs.engine.protocol import Protocol
from qgs.engine.results import METHODS, METRICS
from qgs.metrics import OPACITY_USED, spread

DISPERSIONS = ("dispersion_mean", "dispersion_median")
"""Over a scene's Gaussians, of the distance to their token's centroid, world units."""

TUNING: tuple[str, str] = ("tuning_loss_before", "tuning_loss_after")


def column(method: str, metric: str) -> str:
    """What one of METRICS of one of METHODS is called in `SceneScore.values`."""
    return f"{method}_{metric}"


@dataclass(frozen=True)
class SceneScore:
    """One scene. views: input and target frames of each of its samples.

    values: image metrics by `column`, means over the target views of a sample, then over samples;
    DISPERSIONS; "gaussians_used"; of tuned scenes TUNING.
    """

    scene: str
    views: Sequence[tuple[Frames, Frames]]
    values: Mapping[str, float]

    @property
    def given(self) -> tuple[int, ...]:
        """Frames that one of the samples has as input and as target."""
        both = [given_targets(*frames) for frames in self.views]
        return tuple(sorted({frame for frames in both for frame in frames}))


@dataclass(frozen=True)
class Evaluation:
    """All scenes and what they amount to; the same weights and recipe give the same numbers.

    scores: of the scenes that were judged. wanted: names of all that the protocol names. missing:
    those without a score. null: scenes that the index lists without frames. unlisted: scenes of the
    data that the index lacks. gaussians: how many a scene has. empty: metrics that could not be
    computed, and why. held_out: how many held-out frames were judged, and how many there are; None
    where the test scenes hold none out. step: optimiser steps behind the weights.
    """

    protocol: Protocol
    scores: Sequence[SceneScore]
    wanted: Sequence[str]
    gaussians: int
    missing: Sequence[SceneFailure] = ()
    null: Sequence[str] = ()
    unlisted: Sequence[str] = ()
    empty: Mapping[str, str] = field(default_factory=dict)
    held_out: tuple[int, int] | None = None
    step: int | None = None

    def mean(self, metric: str, method: str = "model") -> float | None:
        """Mean over the judged scenes of one of METRICS of one of METHODS; None if it is empty.

        Scenes weigh alike, however many samples and views they have.
        """
        return None if metric in self.empty else self.mean_value(column(method, metric))

    def mean_value(self, name: str) -> float:
        """Mean over the judged scenes of one of `SceneScore.values`."""
        return sum(score.values[name] for score in self.scores) / len(self.scores)

    @property
    def is_complete(self) -> bool:
        """Whether every scene that the protocol names has a score."""
        return not self.missing

    def summary(self) -> dict[str, Any]:
        """Everything but the scores of single scenes, as plain values for JSON.

        Dispersion and used Gaussians: mean, variance and median over scenes.
        """
        return {
            "protocol": {
                "name": self.protocol.name,
                "sha256": self.protocol.sha256,
                "settings": self.protocol.settings(),
            },
            "step": self.step,
            "statement": results.statement(self),
            "scenes": len(self.scores),
            "scenes_in_protocol": len(self.wanted),
            "samples": sum(len(score.views) for score in self.scores),
            "missing": {failure.scene: failure.reason for failure in self.missing},
            "null_entries": list(self.null),
            "not_in_index": list(self.unlisted),
            "context_and_target": {s.scene: list(s.given) for s in self.scores if s.given},
            **{method: {m: self.mean(m, method) for m in METRICS} for method in METHODS},
            "empty": dict(self.empty),
            "dispersion_over_gaussians": {
                name.removeprefix("dispersion_"): self._spread(name) for name in DISPERSIONS
            },
            "gaussians": self.gaussians,
            "gaussians_used": {"opacity_above": OPACITY_USED, **self._spread("gaussians_used")},
            "tuning": self._tuning(),
            "held_out_frames": self.held_out,
        }

    def write(self, folder: str | Path) -> None:
        """Write scenes.csv, summary.json, table.md and protocol.json, each whole or not at all.

        protocol.json is `Protocol.canonical`: its SHA-256 is the protocol's hash.
        """
        results.write(self, Path(folder))

    def show(self, console: Console) -> None:
        """Print the table that a person compares by, and what is to be known beside it."""
        results.show(self, console)

    def _spread(self, name: str) -> dict[str, float]:
        values = torch.tensor([score.values[name] for score in self.scores], dtype=torch.float64)
        return asdict(spread(values))

    def _tuning(self) -> dict[str, Any] | None:
        settings = self.protocol.content["tuning"]
        if settings is None:
            return None
        before, after = (self.mean_value(name) for name in TUNING)
        return {**settings, "loss_before": before, "loss_after": after}
