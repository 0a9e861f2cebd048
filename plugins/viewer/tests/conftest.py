import numpy as np
import pytest
from hand_made_model import cameras, model

pytest.importorskip("viser", reason="viser is not installed: pip install query-gaussians-viewer")

__all__ = ["cameras", "model"]


@pytest.fixture(autouse=True, scope="module")
def _short_loops():
    """Files beside the point take no time: loops of reconstructions, overviews."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("qgs.reconstruction.saving.ORBIT_FRAMES", 2)
        patch.setattr("qgs.reconstruction.saving.ORBIT_SIDE", 32)
        picture = np.zeros((8, 8, 3), np.uint8)
        patch.setattr("qgs.reconstruction.saving.overview", lambda result: picture)
        yield
