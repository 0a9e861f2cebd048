"""How many scales a head holds back at its cap, its option `scale_cap`."""

from qgs.contracts import Head, ViewsConfig
from qgs.metrics.dispersion import OPACITY_USED
from qgs.types import Gaussians

TOLD = 0.25
"""Least share of capped scales that is told. Where a scene's Gaussians fit, a percent is capped."""


def capped_share(head: Head, gaussians: Gaussians) -> float:
    """Share, in [0, 1], of the scales of visible Gaussians at the cap; 0 for a head without one."""
    cap = getattr(head.config, "scale_cap", float("inf"))
    scales = gaussians.scales[gaussians.opacities > OPACITY_USED]
    return float((scales >= cap * (1 - 1e-4)).float().mean()) if len(scales) else 0.0


def too_many_capped(head: Head, share: float, views: ViewsConfig) -> str:
    """A sentence where a `share` of TOLD or more of the scales is at the cap, else ""."""
    constant = "" if views.scale == "constant" else " with views.scale: constant"
    return "" if share < TOLD else (
        f"{share:.0%} of the scales of visible Gaussians are at the cap, model.head.scale_cap: "
        f"{getattr(head.config, 'scale_cap', 0):g}, so the scene needs larger Gaussians than the "
        "model makes: train with a larger scale_cap, or where only these photos are so, take a "
        f"smaller views.scale_factor{constant}"
    )  # fmt: skip
