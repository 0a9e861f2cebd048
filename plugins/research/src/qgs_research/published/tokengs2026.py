"""Published weights of TokenGS 2026.6: parameter names, and the recipe that fits."""

from typing import Any

from qgs.checkpoint.tensors import Shapes
from qgs_research.published.tokengs import TOKENGS, read_tokengs
from qgs_research.published.weight_layout import LayoutError, layer_count, layout, size_at

READOUT = "enc_dec_backbone.multiscale_norms."
DYNAMIC = "gs_tokens_dynamic"
LATENTS = "enc_dec_backbone.latents"
LATENT_BLOCK = "enc_dec_backbone.latent_blocks."


def _read(shapes: Shapes) -> dict[str, Any]:
    tree = read_tokengs(shapes)
    model = tree["model"]
    model["encoder"] |= _encoder(shapes, model["encoder"]["depth"])
    model["encoder"]["time_channels"] = _channels(shapes, "patch_time_embed")
    dynamic = DYNAMIC in shapes
    timed = _channels(shapes, "patch_time_embed_tgt")
    if dynamic:
        model["decoder"]["self_attention"] = {"type": "tokengs2026/block_causal"}
    if dynamic or timed:
        moving = size_at(shapes, DYNAMIC) if dynamic else 0
        model["queries"] = {
            "type": "tokengs2026/dynamic",
            "count": model["queries"]["count"] + moving,
            "dynamic": moving,
            "patch_size": model["encoder"]["patch_size"],
            "time_channels": timed,
        }
    model["centers"]["z_offset"] = 0.0
    tree |= {"plugins": ["tokengs2026"], "views": {"frame": "mean_cam"}}
    return tree | ({"evaluation": {"tuning": "latents"}} if LATENTS in shapes else {})


def _channels(shapes: Shapes, module: str) -> int:
    """Return the channels of the time embedding in `module`, or 0 if it has none."""
    name = f"{module}.proj.weight"
    return size_at(shapes, name, 1) if name in shapes else 0


def _encoder(shapes: Shapes, depth: int) -> dict[str, Any]:
    """Return the encoder options that TokenGS 2026.6 adds to TokenGS. depth: number of blocks."""
    scales = layer_count(shapes, READOUT)
    if scales > depth:
        raise LayoutError(
            f"{READOUT} has {scales} norms, one for each used block, but there are only {depth} "
            "blocks"
        )
    # files do not say which blocks are read: the release reads every second one
    step = 2 if 2 * scales <= depth + 1 else 1
    found: dict[str, Any] = {"blocks": list(range(depth - step * (scales - 1), depth + 1, step))}
    if LATENTS not in shapes:
        return {"type": "tokengs2026/multiscale_vit", **found}
    blocks = layer_count(shapes, LATENT_BLOCK)
    found |= {"latents": size_at(shapes, LATENTS), "latent_depth": blocks}
    return {"type": "tokengs2026/latent_bottleneck", **found}


TOKENGS_2026_6 = layout("tokengs2026", _read, TOKENGS)
