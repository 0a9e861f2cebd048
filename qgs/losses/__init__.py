"""What training minimises."""

from qgs.losses.photometric import Photometric
from qgs.losses.visibility import (
    BehindCamera,
    Visibility,
    VisibilityOptions,
    view_visibility,
)

COMPONENTS = (Photometric, Visibility)

__all__ = [
    "COMPONENTS",
    "BehindCamera",
    "Photometric",
    "Visibility",
    "VisibilityOptions",
    "view_visibility",
]
