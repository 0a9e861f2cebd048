"""Parameters of Landmark at published size: none of them depends on the number of anchors."""

from pathlib import Path

import pytest

import qgs

RECIPES = Path(__file__).parents[3] / "recipes"

D, LAYERS, HEADS, SWEEP = 1024, 12, 16, 32
TOKENGS = 222_016_768 - 4096 * D  # without its 4,096 learned queries
GAMMAS = LAYERS
OF_PLACES = (3 * 128 * D + D) + (D * D + D)  # of an `anchor_aware` layer, as in LocusGS
NEIGHBOURS = (5 * 32 + 32) + (32 * HEADS + HEADS) + 5 * HEADS * D
REFINEMENT = (D * D + D) + (D * 3 + 3) + (D * D + D) + (D + 1)
QUERIES = D + (D * D + D) + (D * SWEEP + SWEEP) + 2 + (SWEEP * D + D)
LANDMARK = (
    TOKENGS + GAMMAS + LAYERS // 2 * (OF_PLACES + NEIGHBOURS) + REFINEMENT + QUERIES
)  # fmt: skip


@pytest.mark.parametrize("recipe", ["re10k", "re10k_4096", "dl3dv", "dl3dv_4096_4views"])
def test_parameters(recipe: str) -> None:
    model = qgs.compose(RECIPES / "landmark" / f"{recipe}.yaml", device="meta")
    assert sum(parameter.numel() for parameter in model.parameters()) == LANDMARK == 230_201_874
