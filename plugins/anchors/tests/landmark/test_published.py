"""Parameters of Landmark at published size: none of them depends on the number of anchors."""

import qgs


def test_parameters():
    """TokenGS's 222,016,768, less its 4,096 learned queries, and 12,379,410 of places, neighbours,
    the refinement and the queries."""
    for recipe in ("re10k", "re10k_4096", "dl3dv", "dl3dv_4096_4views"):
        model = qgs.compose(f"landmark/{recipe}.yaml", device="meta")
        assert sum(parameter.numel() for parameter in model.parameters()) == 230_201_874
