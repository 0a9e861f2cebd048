"""Which Gaussians count as used."""

from __future__ import annotations

import torch

from qgs.metrics import OPACITY_USED, gaussians_used


def test_only_gaussians_that_a_renderer_can_draw_are_used() -> None:
    opacities = torch.tensor([[0.0, OPACITY_USED / 2, 0.5, 1.0], [0.0, 0.0, 0.0, 0.01]])
    assert gaussians_used(opacities).tolist() == [2, 1]
