"""Slot `metrics`: how good a reconstruction is."""

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
    """Display of a value in tables. digits: after the point; comparisons show one more."""

    heading: str
    better: Literal["higher", "lower"]
    digits: int = 3
    unit: str = ""

    @property
    def title(self) -> str:
        """The heading with an arrow that points to what is better."""
        return f"{self.heading} {'↑' if self.better == 'higher' else '↓'}"

    def shown(self, value: float | None) -> str:
        """`value` in a table; a dash for None."""
        return "–" if value is None else f"{value:.{self.digits}f}"

    def best(self, values: Iterable[float | None]) -> float | None:
        """The best of `values`, None if there is none."""
        # A method without Gaussians has no value of metrics that need them.
        known = [value for value in values if value is not None]
        return (max if self.better == "higher" else min)(known, default=None)

    def beats(self, value: float | None, other: float | None) -> bool:
        """Return whether `value` is better than `other` in the digits that tables show."""
        # 14.463 and 14.457 both read 14.46: a sentence that ranks them would puzzle its reader
        if other is None or self.shown(value) == self.shown(other):
            return False
        return self.best((value, other)) == value


@dataclass(frozen=True)
class MetricInput(TensorContainer):
    """One scene: the true views, and what a model or a baseline shows in their place.

    images: (1, T, 3, H, W) as rendered, not clipped. targets: the true Views (1, T).
    gaussians: (1, G), `gaussians_per_query` of each query in turn; None for a baseline.
    depth: as `Rendering.depth` (1, T, 1, H, W); None for a baseline. true_depth: the same of the
    data, in the model's units, 0 where unknown; None without maps, or where no metric needs it.
    """

    images: Tensor
    targets: Views
    gaussians: Gaussians | None = None
    gaussians_per_query: int = 1
    depth: Tensor | None = None
    true_depth: Tensor | None = None

    @property
    def masks(self) -> Tensor | None:
        """Masks (1, T, 1, H, W) of the true views, None where they have none."""
        return self.targets.masks


class Metric(Component, torch.nn.Module):
    """MetricInput -> values. Called without gradients, for every sample and every method.

    definition: text, what is measured; part of the evaluation protocol, as the options are:
    change it when values change. not_in_protocol: options that change no value, such as a path.
    needs: parts of the input without which there is no value. column: how the value is shown.
    unavailable: why there are no values here: what `load_pretrained` misses.
    """

    slot: ClassVar[str] = "metrics"
    definition: ClassVar[str]
    not_in_protocol: ClassVar[frozenset[str]] = frozenset()
    needs: ClassVar[tuple[Literal["masks", "gaussians", "depth", "true_depth"], ...]] = ()
    column: ClassVar[Column]
    unavailable: str = ""

    def columns(self) -> Mapping[str, Column]:
        """Columns of values by key; override it for several values or headings by option.

        A value is called as the recipe calls the metric, with `_KEY` behind unless the key is "".
        """
        return {"": self.column}

    @abstractmethod
    def forward(self, given: MetricInput) -> Tensor | Mapping[str, Tensor]:
        """A tensor such as (1, T), one number per view, or several by the keys of `columns`.

        A sample's value is the mean of all numbers in float64, a scene's that of its samples.
        """
