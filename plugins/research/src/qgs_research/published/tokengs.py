"""Published weights of TokenGS: parameter names, and the recipe that fits a state dict."""

from typing import Any

from qgs.checkpoint.tensors import Shapes
from qgs.tokengs.head import CHANNELS
from qgs_research.published.weight_layout import (
    layer_count,
    layout,
    real_ratio,
    size_at,
    whole_ratio,
)

ENCODER = "enc_dec_backbone.encoder."
DECODER = "enc_dec_backbone.decoder_blocks."


def backbone(shapes: Shapes, queries: str) -> dict[str, Any]:
    """Return the options of `model` that TokenGS shares with models built on it.

    queries: component type of `model.queries`. Raises LayoutError for shapes that do not fit.
    """
    count = size_at(shapes, "gs_tokens")
    width = size_at(shapes, "gs_tokens", 1)
    head_width = size_at(shapes, "enc_dec_backbone.k_proj_norm.weight")
    channels = size_at(shapes, "activation_head.deconv.weight")
    encoder = {
        "type": "qgs/multiview_vit",
        "patch_size": size_at(shapes, "patch_embed.proj.weight", -1),
        "depth": layer_count(shapes, ENCODER),
    }
    if encoder["depth"]:
        hidden = size_at(shapes, ENCODER + "0.mlp.fc1.weight")
        encoder["mlp_ratio"] = real_ratio(hidden, width, "hidden width of the encoder's MLP")
    hidden = size_at(shapes, DECODER + "0.mlp.mlp.fc1.weight")
    ratio = real_ratio(hidden, width, "hidden width of the decoder's MLP")
    gaussians = whole_ratio(channels, sum(CHANNELS), "channels of the head")
    return {
        "width": width,
        "heads": whole_ratio(width, head_width, "width over the width of one head"),
        "encoder": encoder,
        "queries": {"type": queries, "count": count},
        "decoder": {
            "depth": layer_count(shapes, DECODER),
            "feed_forward": {"type": "qgs/mlp", "ratio": ratio},
        },
        "head": {"type": "qgs/gaussian_head", "gaussians_per_query": gaussians},
    }


def read_tokengs(shapes: Shapes) -> dict[str, Any]:
    """Return the recipe that fits the weights of a TokenGS. Raises LayoutError if none fits."""
    model = backbone(shapes, "qgs/latent")
    model["decoder"] |= {
        "cross_attention": {"type": "qgs/content"},
        "self_attention": {"type": "qgs/content"},
        "refinement": {"type": "qgs/none"},
    }
    model["head"] |= {"scale_input_limit": None, "quat_eps": 1e-12}
    unlimited = {"input_limit": None, "output_limit": None}
    model["centers"] = {"type": "qgs/free", "z_offset": 1.0, **unlimited}
    model["supervision"] = {"type": "qgs/layers", "layers": [model["decoder"]["depth"]]}
    return {"recipe": 1, "model": model}


TOKENGS = layout("tokengs", read_tokengs)
