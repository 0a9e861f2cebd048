"""Data sources, which provide scenes, and samplers that choose input and target views."""

from qgs.contracts import Component
from qgs.data.photos.source import PhotosSource
from qgs.data.view_samplers import Span

COMPONENTS: tuple[type[Component], ...] = (PhotosSource, Span)

__all__ = ["COMPONENTS", "PhotosSource"]
