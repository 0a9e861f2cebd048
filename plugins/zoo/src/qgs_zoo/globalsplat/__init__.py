"""GlobalSplat for qgs: scene tokens with two streams, for geometry and texture of Gaussians."""

from qgs.contracts import Plugin
from qgs_zoo.globalsplat.encoder import PosedPatches
from qgs_zoo.globalsplat.head import MergingHead
from qgs_zoo.globalsplat.losses import Frustum, Regularisers, TwoPasses
from qgs_zoo.globalsplat.streams import Round, SlotQueries

plugin = Plugin(
    name="globalsplat",
    contract_version=1,
    components=(PosedPatches, SlotQueries, Round, MergingHead, Frustum, Regularisers, TwoPasses),
    examples=(
        PosedPatches.Config(patch_size=4, rgb_width=24, ray_width=16, bands=2, registers=0),
        SlotQueries.Config(count=12, extra=3, std=0.3),
        SlotQueries.Config(count=8, extra=0),
        Round.Config(memory_width=40, blocks=1, mlp_ratio=2.0, block_layer_scale=0.3),
        MergingHead.Config(candidates=8, level=1.25, position_std=0.1),
        MergingHead.Config(candidates=4, level=2.0, sh_degree=0),
        MergingHead.Config(candidates=8, level=0.0, sh_degree=1, scale_min=0.3, scale_max=0.5),
        Frustum.Config(weight=1.0, softness=0.2),
    ),
    exemptions={
        Round: {
            "masked_queries_are_not_read": "masked tokens are not missing queries here, but "
            "registers, which decode nothing and which all tokens read"
        },
        PosedPatches.Config(): {  # type: ignore[reportUnhashable]  # frozen, which pyright misses
            "view_permutation": "its registers belong to no view, so its memory has no grid to "
            "permute by; its patches are permuted with their views, as without registers"
        },
    },
)
