"""Token dispersion."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from qgs.metrics import spread, token_dispersion
from qgs.metrics.dispersion import median


def test_distances_to_the_centroid_of_each_token() -> None:
    means = torch.randn(2, 5 * 4, 3, generator=torch.Generator().manual_seed(0))
    expected = np.empty((2, 20))
    for b in range(2):
        for n in range(5):
            token = means[b, 4 * n : 4 * n + 4].numpy()
            expected[b, 4 * n : 4 * n + 4] = np.linalg.norm(token - token.mean(0), axis=1)
    torch.testing.assert_close(
        token_dispersion(means, 4), torch.from_numpy(expected).float(), rtol=1e-5, atol=1e-6
    )


def test_dispersion_is_zero_when_tokens_are_points() -> None:
    points = torch.randn(1, 6, 1, 3).expand(-1, -1, 3, -1).flatten(1, 2)
    assert token_dispersion(points, 3).max() < 1e-6


def test_a_count_that_tokens_do_not_share_is_refused() -> None:
    with pytest.raises(ValueError, match="10 Gaussians"):
        token_dispersion(torch.zeros(1, 10, 3), 4)


@pytest.mark.parametrize("count", [5, 8])
def test_spread_and_median_equal_numpy(count: int) -> None:
    values = torch.rand(count, generator=torch.Generator().manual_seed(count))
    found = spread(values)
    plain = values.double().numpy()
    assert found.mean == pytest.approx(plain.mean())
    assert found.variance == pytest.approx(plain.var())
    assert found.median == pytest.approx(np.median(plain))
    assert float(median(values)) == pytest.approx(np.median(plain))


def test_spread_of_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="no scene"):
        spread(torch.empty(0))
