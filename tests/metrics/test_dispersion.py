"""What is measured on Gaussians alone."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from qgs.contracts import MetricInput
from qgs.evaluate.results import spread
from qgs.metrics.dispersion import Dispersion, token_dispersion


def test_distances_to_the_centroid_of_each_token():
    means = torch.randn(2, 5 * 4, 3)
    tokens = [token - token.mean(0) for scene in means for token in scene.split(4)]
    expected = torch.cat([token.norm(dim=1) for token in tokens]).view(2, 20)
    assert_close(token_dispersion(means, 4), expected)
    with pytest.raises(ValueError, match="20 Gaussians"):
        token_dispersion(means, 6)
    for scene, distances in zip(means, expected, strict=True):
        scene = scene[None]
        given = MetricInput(scene, None, SimpleNamespace(means=scene), 4)
        found = Dispersion(Dispersion.Config())(given)
        assert float(found["mean"].mean()) == pytest.approx(distances.mean())
        assert float(found["median"]) == pytest.approx(np.median(distances))


def test_the_spread_over_scenes():
    assert spread([1.0, 2.0, 4.0, 9.0]) == {"mean": 4.0, "variance": 9.5, "median": 3.0}
