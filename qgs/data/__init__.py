"""Where scenes come from, and how views are drawn from them."""

from qgs.contracts import Component
from qgs.data.frames import Span
from qgs.data.photos.source import PhotosSource

COMPONENTS: tuple[type[Component], ...] = (PhotosSource, Span)

__all__ = ["COMPONENTS", "PhotosSource"]
