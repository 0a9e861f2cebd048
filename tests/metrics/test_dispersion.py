"""What is measured on Gaussians alone."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from qgs.contracts import MetricInput
from qgs.engine.results import spread
from qgs.metrics.dispersion import Dispersion, token_dispersion


def test_distances_to_the_centroid_of_each_token():
    means = torch.randn(2, 5 * 4, 3)
    tokens = [token - token.mean(0) for scene in means for token in scene.split(4)]
    expected = torch.cat([token.square().sum(1).sqrt() for token in tokens]).view(2, 20)
    torch.testing.assert_close(token_dispersion(means, 4), expected, rtol=1e-5, atol=1e-6)
    with pytest.raises(ValueError, match="20 Gaussians"):
        token_dispersion(means, 6)


def test_the_spread_over_scenes():
    assert spread([1.0, 2.0, 4.0, 9.0]) == {"mean": 4.0, "variance": 9.5, "median": 3.0}


def test_the_metric_has_mean_and_median_over_gaussians():
    for per_query in (5, 8):
        means = torch.rand(1, 3 * per_query, 3)
        given = MetricInput(means, None, SimpleNamespace(means=means), per_query)
        found = Dispersion(Dispersion.Config())(given)
        distances = token_dispersion(means, per_query).numpy()
        assert float(found["mean"].mean()) == pytest.approx(distances.mean())
        assert float(found["median"]) == pytest.approx(np.median(distances))
