"""What training minimises."""

from qgs.losses.opacity import Mask, Opacity
from qgs.losses.photometric import Photometric
from qgs.losses.visibility import (
    BehindCamera,
    Visibility,
    VisibilityOptions,
    view_visibility,
)

COMPONENTS = (Photometric, Visibility, Mask, Opacity)

__all__ = [
    "COMPONENTS",
    "BehindCamera",
    "Mask",
    "Opacity",
    "Photometric",
    "Visibility",
    "VisibilityOptions",
    "view_visibility",
]
