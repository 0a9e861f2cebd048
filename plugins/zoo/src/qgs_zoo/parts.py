"""Parts that several systems share: attention, rays of pixels, rotations, weight files."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import torch
import torch.nn.functional as F
from safetensors.torch import load_file
from torch import Tensor, nn

from qgs.containers import concatenated
from qgs.contracts import FieldSpec, MissingExtraError, Outcome
from qgs.geometry.constants import constant
from qgs.geometry.rays import pixel_directions
from qgs.precision import full_precision
from qgs.tokengs.blocks import merge_heads, split_heads
from qgs.types import Cameras

PIXEL_RAYS = FieldSpec(
    (4, 3),
    frame="world",
    encoding="camera centre; directions of z = 1: upper left corner, step across, step down",
)
"""Field of the rays through a pixel or patch, (B, N, 4, 3).

The ray through the point (u, v), from (0, 0) to (1, 1), has the direction corner + u * step across
+ v * step down."""


class Decaying:
    """Part of components all of whose parameters have weight decay, as in the released code."""

    def decays(self, name: str, parameter: nn.Parameter) -> bool:
        return True


def self_attention(qkv_BTX: Tensor, heads: int, mask: Tensor | None = None) -> Tensor:
    """Return multi-head self-attention (B, T, D) for concatenated q, k and v (B, T, 3 D).

    mask: booleans that broadcast to (B, heads, T, T), True where a query (row) attends to a key
    (column). None means that all queries attend to all keys.
    """
    q_BhTd, k_BhTd, v_BhTd = (split_heads(part, heads) for part in qkv_BTX.chunk(3, -1))
    return merge_heads(F.scaled_dot_product_attention(q_BhTd, k_BhTd, v_BhTd, attn_mask=mask))


@full_precision
def feature_lenses(cameras: Cameras, size: Sequence[int]) -> Tensor:
    """Return the intrinsics (B, V, 4) of cameras after resizing the images to `size` (H, W)."""
    scale = (size[1] / cameras.size[1], size[0] / cameras.size[0])
    return cameras.intrinsics * constant([*scale, *scale], cameras.intrinsics)


@full_precision
def pixel_rays(cameras: Cameras, rows: int, columns: int) -> Tensor:
    """Return the rays of each cell of images that are divided into rows x columns cells.

    The result (B, V * rows * columns, 4, 3) is encoded as PIXEL_RAYS: the camera's centre,
    the direction through the cell's upper left corner, and what to add to this direction to reach
    the upper right and the lower left corner.
    """
    c2w = cameras.c2w
    lens = feature_lenses(cameras, (rows, columns))
    # The half moves rays from the centres of cells to their corners.
    local = pixel_directions(lens + constant([0, 0, 0.5, 0.5], lens), (rows, columns))
    corner = torch.einsum("bvij,bvrcj->bvrci", c2w[..., :3, :3], local)
    across, below = (c2w[..., :3, :2] / lens[..., None, :2]).unbind(-1)
    origin, across, below = (x[:, :, None, None] for x in (c2w[..., :3, 3], across, below))
    parts = torch.broadcast_tensors(origin, corner, across, below)
    return torch.stack(parts, -2).flatten(1, 3)


@full_precision
def quaternions(rotations: Tensor) -> Tensor:
    """Convert rotations (..., 3, 3) to unit quaternions w x y z (..., 4), of arbitrary sign."""
    from kornia.geometry.conversions import rotation_matrix_to_quaternion

    # Kornia's have unit length only for exact rotations.
    return F.normalize(rotation_matrix_to_quaternion(rotations), dim=-1)


@contextmanager
def weight_file(file: str, remedy: str) -> Iterator[Mapping[str, Tensor]]:
    """Give the tensors of a weight file to a `with` block. Nothing is downloaded.

    file: a safetensors file or a torch file. The tensors of a torch file may be in its entry
    `model` or `state_dict`. Raises MissingExtraError, whose message ends with `remedy`, if the file
    is missing or the block fails.
    """
    path = Path(file).expanduser()
    try:
        if path.suffix == ".safetensors":
            tensors = load_file(path)
        else:
            # Never run code from a file.
            tensors = torch.load(path, map_location="cpu", weights_only=True)
            for key in ("model", "state_dict"):
                tensors = tensors.get(key, tensors)
        yield tensors
    except Exception as error:
        # torch and safetensors raise many errors for missing, damaged and other files.
        what = f"cannot read weights of {path.name} ({type(error).__name__}: {error})"
        raise MissingExtraError(f"{what}; {remedy}") from error


def mean_outcome(outcomes: Sequence[Outcome], **terms: Tensor) -> Outcome:
    """Return the mean of the `outcomes` of several passes, with `terms` added to the objective.

    All outcomes must have the same losses. terms: further losses by name, already weighted, 0-d.
    Raises ValueError if an outcome has a loss with the name of one of the `terms`.
    """
    # Of two equal names, the log would lose one.
    if taken := sorted(outcomes[0].terms.keys() & terms.keys()):
        raise ValueError(
            f"the recipe's losses have terms {taken} already, which the objective adds itself; "
            "rename these losses"
        )
    parts = [(outcome.total, outcome.terms, outcome.signs) for outcome in outcomes]
    total, judged, signs = concatenated(parts, 0, lambda each, dim: torch.stack(each).mean(dim))
    # The maximum, because a mean would hide a single collapsed pass.
    spread = torch.stack([o.signs["deviation"] for o in outcomes]).amax()
    # Detached for the log: a graph would keep the memory of the step.
    detached = {n: term.detach() for n, term in terms.items()}
    total = total + torch.stack([*terms.values()]).sum()
    return Outcome(total, {**judged, **detached}, {**signs, "deviation": spread})
