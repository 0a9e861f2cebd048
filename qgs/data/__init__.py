"""Where scenes come from, and how views are drawn from them."""

from qgs.contracts import Component
from qgs.data.chunks import ChunksSource
from qgs.data.dl3dv import Dl3dvSource
from qgs.data.photos.source import PhotosSource
from qgs.data.samplers import Bounded, Span

COMPONENTS: tuple[type[Component], ...] = (ChunksSource, Dl3dvSource, PhotosSource, Span, Bounded)
"""Sources come in the order in which they are asked whether they recognise a path."""

__all__ = ["COMPONENTS", "ChunksSource", "Dl3dvSource", "PhotosSource"]
