"""What training minimises."""

from qgs.losses.lpips import LpipsLoss
from qgs.losses.means import mean_of_gaussians
from qgs.losses.opacity import Mask, Opacity
from qgs.losses.photometric import Photometric
from qgs.losses.visibility import Visibility, VisibilityOptions, view_visibility

COMPONENTS = (Photometric, Visibility, Mask, Opacity, LpipsLoss)

__all__ = [
    "COMPONENTS",
    "LpipsLoss",
    "Mask",
    "Opacity",
    "Photometric",
    "Visibility",
    "VisibilityOptions",
    "mean_of_gaussians",
    "view_visibility",
]
