"""Losses that training minimises: on images, masks, depth, opacity and visibility."""

from qgs.losses.depth import DepthSurface
from qgs.losses.photometric import Mask, Opacity, Photometric, mean_of_gaussians
from qgs.losses.visibility import Visibility, VisibilityOptions, view_visibility

COMPONENTS = (Photometric, Visibility, Mask, Opacity, DepthSurface)

__all__ = [
    "COMPONENTS",
    "DepthSurface",
    "Mask",
    "Opacity",
    "Photometric",
    "Visibility",
    "VisibilityOptions",
    "mean_of_gaussians",
    "view_visibility",
]
