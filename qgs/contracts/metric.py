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
    """Display of a metric's value in tables.

    better: whether higher or lower values are better. unit: unit of the value; "" for none.
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
        """Format `value` for a table; a dash for None."""
        return "–" if value is None else f"{value:.{self.digits}f}"

    def best(self, values: Iterable[float | None]) -> float | None:
        """Return the best of `values`, ignoring None; None if no number remains."""
        # A method without Gaussians has no values for metrics that need them.
        known = [value for value in values if value is not None]
        return (max if self.better == "higher" else min)(known, default=None)

    def beats(self, value: float | None, other: float | None) -> bool:
        """Return whether `value` is better than `other` after rounding as in tables.

        False if `value` or `other` is None.
        """
        # 14.463 and 14.457 both show as 14.46; ranking them would confuse readers
        if other is None or self.shown(value) == self.shown(other):
            return False
        return self.best((value, other)) == value


@dataclass(frozen=True)
class MetricInput(TensorContainer):
    """Input of a metric for one scene: T true views, and the images of a model or a baseline.

    images: (1, T, 3, H, W) as rendered, not clipped to [0, 1].
    targets: the true Views (1, T).
    gaussians: (1, G), ordered query by query, `gaussians_per_query` of each; None for a baseline.
    depth: rendered depth (1, T, 1, H, W) as in `Rendering`; None for a baseline.
    true_depth: depth maps (1, T, 1, H, W) of the data, in the model's units, 0 where unknown; None
        without maps, or if no metric needs them.
    """

    images: Tensor
    targets: Views
    gaussians: Gaussians | None = None
    gaussians_per_query: int = 1
    depth: Tensor | None = None
    true_depth: Tensor | None = None

    @property
    def masks(self) -> Tensor | None:
        """Object masks (1, T, 1, H, W) of the true views; None if the data has no masks."""
        return self.targets.masks


class Metric(Component, torch.nn.Module):
    """Metric: MetricInput -> values.

    A metric is called without gradients, for every sample, with the images of the model and of each
    baseline.

    definition: a text that says what is measured. Like the options, it enters the hash of the
        evaluation protocol; change it whenever the metric's values change.
    not_in_protocol: options that change no value, such as a path; they do not enter the hash.
    needs: fields of MetricInput that must not be None for the metric to have a value.
    column: display of the value in tables.
    unavailable: reason why the metric has no values, such as a missing file of weights; "" if the
        metric has values.
    """

    slot = "metrics"
    definition: ClassVar[str]
    not_in_protocol: ClassVar[frozenset[str]] = frozenset()
    needs: ClassVar[tuple[Literal["masks", "gaussians", "depth", "true_depth"], ...]] = ()
    column: ClassVar[Column]
    unavailable: str = ""

    def columns(self) -> Mapping[str, Column]:
        """Return the table columns by key; the default is `column` with the key "".

        Override this method if the metric has several values, or a heading that depends on options.
        In results, the name of a value is the metric's name in the recipe, plus `_KEY` unless the
        key is "".
        """
        return {"": self.column}

    @abstractmethod
    def forward(self, given: MetricInput) -> Tensor | Mapping[str, Tensor]:
        """Return a tensor of values, or one tensor for each key of `columns`.

        For example, a tensor (1, T) holds one value per view. The value of a sample is the mean
        over the tensor, in float64. The value of a scene is the mean over its samples.
        """
