import numpy as np
import pytest
from hand_made_model import cameras, gaussians, model

pytest.importorskip("viser", reason="viser is not installed: pip install query-gaussians-viewer")

__all__ = ["cameras", "gaussians", "model"]


@pytest.fixture(autouse=True, scope="module")
def _short_loops():
    """Files beside the point take no time: loops of reconstructions, overviews."""
    from qgs.reconstruction import saving

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(saving, "ORBIT_FRAMES", 2)
        patch.setattr(saving, "ORBIT_SIDE", 32)
        patch.setattr(saving, "overview", lambda result: np.zeros((8, 8, 3), np.uint8))
        yield
