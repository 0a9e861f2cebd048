"""TokenGS 2026.6 for qgs: encoders that read several ViT blocks, and queries for moving scenes."""

from qgs.contracts import Plugin
from qgs_zoo.tokengs2026.dynamic import BlockCausalSelfAttention, DynamicObjective, DynamicQueries
from qgs_zoo.tokengs2026.multiscale import LatentBottleneck, MultiscaleViT

plugin = Plugin(
    name="tokengs2026",
    contract_version=1,
    components=(
        MultiscaleViT,
        LatentBottleneck,
        DynamicQueries,
        BlockCausalSelfAttention,
        DynamicObjective,
    ),
    examples=(
        MultiscaleViT.Config(blocks=(2, 3), time_channels=2),
        LatentBottleneck.Config(depth=2, blocks=(1, 2), latents=6, latent_depth=2),
    ),
)
