"""What a loss says of given points and images."""

from pathlib import Path

import torch
from safetensors.torch import load_file

from qgs.types import Cameras, Gaussians, LayerPrediction, QueryState, Rendering

GOLDEN = load_file(Path(__file__).parents[1] / "golden" / "loss_a.safetensors")
"""Inputs and results of the released losses."""
CAMERAS = Cameras(GOLDEN["c2w"], GOLDEN["intrinsics"], (16, 24))
PREDICTED, TRUTH = GOLDEN["images_pred"], GOLDEN["images_gt"]


def judged(loss, views, means=None, opacities=None, rgb=None, alpha=None):
    """The terms of `loss`; what is not given is nothing, opaque or black."""
    means = views.images.new_zeros(len(views.images), 0, 3) if means is None else means
    opacities = torch.ones(means.shape[:2]) if opacities is None else opacities
    quats = torch.ones(*means.shape[:2], 4)
    gaussians = Gaussians(means, torch.ones_like(means), quats, opacities, means.sigmoid())
    rgb = torch.zeros_like(views.images) if rgb is None else rgb
    alpha = rgb[:, :, :1] if alpha is None else alpha
    prediction = LayerPrediction(gaussians, QueryState(means, {"anchor.center": means}))
    return loss(prediction, Rendering(rgb, alpha, alpha), views, views)
