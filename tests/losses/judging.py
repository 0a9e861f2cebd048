"""What a loss says of given points and images."""

import torch
from safetensors.torch import load_file
from size import ROOT

from qgs.types import Cameras, Gaussians, LayerPrediction, QueryState, Rendering

GOLDEN = load_file(ROOT / "tests/golden/loss_a.safetensors")
"""Inputs and results of the released losses."""
CAMERAS = Cameras(GOLDEN["c2w"], GOLDEN["intrinsics"], (16, 24))
PREDICTED = GOLDEN["images_pred"]
TRUTH = GOLDEN["images_gt"]


NO_POINTS = torch.zeros(2, 0, 3)


def judged(loss, views, means=NO_POINTS, opacities=None, rgb=None):
    """The terms of `loss`; what is not given is nothing, opaque or black."""
    quats = torch.ones(*means.shape[:2], 4)
    opacities = quats[..., 0] if opacities is None else opacities
    gaussians = Gaussians(means, quats[..., 1:], quats, opacities, means.sigmoid())
    prediction = LayerPrediction(gaussians, QueryState(means, {"anchor.center": means}))
    rgb = torch.zeros_like(views.images) if rgb is None else rgb
    alpha = rgb[:, :, :1]
    return loss(prediction, Rendering(rgb, alpha, alpha), views, views)
