import pytest
from hand_made_model import cameras, model

pytest.importorskip("viser", reason="viser is not installed: pip install query-gaussians-viewer")

__all__ = ["cameras", "model"]
