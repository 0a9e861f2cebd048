import pytest
from hand_made_model import cameras, gaussians, model
from installing import install

pytest.importorskip("viser", reason="viser is not installed: pip install query-gaussians-viewer")

__all__ = ["cameras", "gaussians", "install", "model"]
