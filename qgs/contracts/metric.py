"""Contract of the slot `metrics`, the quality measures of a reconstruction."""

from abc import abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Tensor

from qgs.containers import TensorContainer
from qgs.contracts.component import Component
from qgs.types import Gaussians, Views


@dataclass(frozen=True)
class Column:
    """Display of a value in tables.

    digits: number of decimal places; tables that compare several results show one more.
    """

    heading: str
    better: Literal["higher", "lower"]
    digits: int = 3
    unit: str = ""

    @property
    def title(self) -> str:
        """Column heading with an arrow: up if higher values are better, else down."""
        return f"{self.heading} {'↑' if self.better == 'higher' else '↓'}"

    def shown(self, value: float | None) -> str:
        """Format `value` for a table; None gives a dash."""
        return "–" if value is None else f"{value:.{self.digits}f}"

    def best(self, values: Iterable[float | None]) -> float | None:
        """Return the best of `values`; None if there is none."""
        # A method without Gaussians has no values for metrics that need them.
        known = [value for value in values if value is not None]
        return (max if self.better == "higher" else min)(known, default=None)

    def beats(self, value: float | None, other: float | None) -> bool:
        """Return whether `value` is better than `other` when both are rounded as in tables."""
        # 14.463 and 14.457 both show as 14.46; ranking them would confuse readers
        if other is None or self.shown(value) == self.shown(other):
            return False
        return self.best((value, other)) == value


@dataclass(frozen=True)
class MetricInput(TensorContainer):
    """Input of a metric for one scene: the true views, and the images of a model or a baseline.

    images: (1, T, 3, H, W) as rendered, not clipped.
    targets: the true Views (1, T).
    gaussians: (1, G), ordered query by query, `gaussians_per_query` each; None for a baseline.
    depth: like `Rendering.depth`, (1, T, 1, H, W); None for a baseline.
    true_depth: depth maps of the data, in the model's units, 0 where unknown; None without maps, or
        if no metric needs them.
    """

    images: Tensor
    targets: Views
    gaussians: Gaussians | None = None
    gaussians_per_query: int = 1
    depth: Tensor | None = None
    true_depth: Tensor | None = None

    @property
    def masks(self) -> Tensor | None:
        """Masks (1, T, 1, H, W) of the true views; None without masks."""
        return self.targets.masks


class Metric(Component, torch.nn.Module):
    """Metric: MetricInput -> values.

    Called without gradients, for every sample, with the images of the model and of each baseline.

    definition: a text that says what is measured. Like the options, it is part of the evaluation
        protocol's hash; change it whenever the metric's values change.
    not_in_protocol: options that change no value, such as a path.
    needs: fields of MetricInput that must not be None for the metric to have a value.
    column: display of the value in tables.
    unavailable: reason why the metric has no values, such as a missing file of weights; else "".
    """

    slot: ClassVar[str] = "metrics"
    definition: ClassVar[str]
    not_in_protocol: ClassVar[frozenset[str]] = frozenset()
    needs: ClassVar[tuple[Literal["masks", "gaussians", "depth", "true_depth"], ...]] = ()
    column: ClassVar[Column]
    unavailable: str = ""

    def columns(self) -> Mapping[str, Column]:
        """Return the table columns by key; the default is `column` with the key "".

        Override it if the metric has several values, or a heading that depends on options. In
        results, a value has the metric's name in the recipe, plus `_KEY` unless the key is "".
        """
        return {"": self.column}

    @abstractmethod
    def forward(self, given: MetricInput) -> Tensor | Mapping[str, Tensor]:
        """Return a tensor such as (1, T), one number per view, or a tensor for each of `columns`.

        The value of a sample is the mean over the tensor, in float64. The value of a scene is the
        mean over its samples.
        """
