"""Where scenes come from, and how views are drawn from them."""

from qgs.contracts import Component
from qgs.data.photos import PhotosSource, read_photos
from qgs.data.rooms import RoomsSource

COMPONENTS: tuple[type[Component], ...] = (PhotosSource, RoomsSource)

__all__ = ["COMPONENTS", "PhotosSource", "RoomsSource", "read_photos"]
