"""MVSplat against tensors that the released code computed."""

import pytest
from recorded import recorded
from released import Released

SUMS_CANCEL = {"cost_volume": (1e-4, 1.5e-4), "warp_grid": (1e-3, 5e-5)}


@pytest.mark.parametrize("name", ["mvsplat_a", "mvsplat_views3_a"])
def test_every_tensor(name: str) -> None:
    released = Released(name)
    assert released.problems(recorded(released), SUMS_CANCEL) == {}
