"""DepthSplat against tensors that the released code computed."""

import pytest
from recorded_depthsplat import recorded
from released import Released

FILES = ["depthsplat_a", "depthsplat_base_eighth_a", "depthsplat_base_a"]
FILES += ["depthsplat_small_eighth_views4_a"]
SUMS_CANCEL = dict.fromkeys(["cost_volume.0", "cost_volume.1"], (1e-4, 1.5e-4))
KINDER = {**SUMS_CANCEL, "warp_grid.0": (1e-3, 5e-5)}


@pytest.mark.parametrize("name", FILES)
def test_every_tensor(name: str) -> None:
    released = Released(name)
    assert released.problems(recorded(released), KINDER) == {}
