"""The weights of TokenGS, whose components are those of the framework."""

from qgs.contracts.weights import WeightLayout
from qgs.tokengs.weights import BACKBONE_RENAMES, CROSS_QUERY, DECODER, read_tokengs

TOKENGS = WeightLayout(
    name="TokenGS",
    source="nv-tlabs/TokenGS",
    components={
        "encoder": ("qgs/multiview_vit",),
        "queries": ("qgs/latent",),
        "cross_attention": ("qgs/content",),
        "self_attention": ("qgs/content",),
        "feed_forward": ("qgs/mlp",),
        "refinement": ("qgs/none",),
        "head": ("qgs/gaussian_head",),
        "centers": ("qgs/free",),
    },
    renames=BACKBONE_RENAMES | CROSS_QUERY,
    marks=(DECODER + "0.gs_cross_attn.q_proj.weight",),
    read=read_tokengs,
    undecided=(
        "activations of the head and of the positions, their clamps and epsilons: TokenGS's",
        "supervised layers: the last",
        "scale and frame of the world, losses, renderer, training: the framework's defaults",
    ),
)
"""The released TokenGS, before its version of June 2026."""
