"""Sources of scenes, and how views are drawn from them."""

from qgs.contracts import Component
from qgs.data.photos.source import PhotosSource
from qgs.data.view_samplers import Span

COMPONENTS: tuple[type[Component], ...] = (PhotosSource, Span)

__all__ = ["COMPONENTS", "PhotosSource"]
