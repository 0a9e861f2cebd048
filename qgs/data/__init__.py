"""Where scenes come from, and how views are drawn from them."""

from qgs.contracts import Component
from qgs.data.chunks import ChunksSource
from qgs.data.dl3dv import Dl3dvSource
from qgs.data.photos import PhotosSource, read_photos
from qgs.data.rooms import RoomsSource

COMPONENTS: tuple[type[Component], ...] = (ChunksSource, Dl3dvSource, PhotosSource, RoomsSource)

__all__ = [
    "COMPONENTS",
    "ChunksSource",
    "Dl3dvSource",
    "PhotosSource",
    "RoomsSource",
    "read_photos",
]
