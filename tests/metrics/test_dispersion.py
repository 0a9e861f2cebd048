"""What is measured on Gaussians alone."""

import numpy as np
import pytest
import torch

from qgs.contracts import MetricInput
from qgs.engine.results import spread
from qgs.metrics.dispersion import Dispersion, token_dispersion
from qgs.types import Cameras, Gaussians, Views

SHAPES = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (), "colors": (3,)}
ONES = torch.ones(1, 1, 4)


def test_distances_to_the_centroid_of_each_token() -> None:
    means = torch.randn(2, 5 * 4, 3, generator=torch.Generator().manual_seed(0))
    tokens = [token - token.mean(0) for scene in means for token in scene.split(4)]
    expected = torch.cat([token.square().sum(1).sqrt() for token in tokens]).view(2, 20)
    torch.testing.assert_close(token_dispersion(means, 4), expected, rtol=1e-5, atol=1e-6)


def test_dispersion_is_zero_when_tokens_are_points() -> None:
    points = torch.randn(1, 6, 1, 3).expand(-1, -1, 3, -1).flatten(1, 2)
    assert token_dispersion(points, 3).max() < 1e-6


def test_a_count_that_tokens_do_not_share_is_refused() -> None:
    with pytest.raises(ValueError, match="10 Gaussians"):
        token_dispersion(torch.zeros(1, 10, 3), 4)


def test_the_spread_over_scenes() -> None:
    assert spread([1.0, 2.0, 4.0, 9.0]) == {"mean": 4.0, "variance": 9.5, "median": 3.0}


@pytest.mark.parametrize("per_query", [5, 8])
def test_the_metric_has_mean_and_median_over_gaussians(per_query: int) -> None:
    gaussians = Gaussians(**{n: torch.rand(1, 3 * per_query, *s) for n, s in SHAPES.items()})
    truth = Views(torch.zeros(1, 1, 3, 2, 2), Cameras(torch.eye(4)[None, None], ONES, (2, 2)))
    given = MetricInput(truth.images, truth, gaussians, per_query)
    found = Dispersion(Dispersion.Config())(given)
    distances = token_dispersion(gaussians.means, per_query).numpy()
    assert float(found["mean"].mean()) == pytest.approx(distances.mean())
    assert float(found["median"]) == pytest.approx(np.median(distances))
