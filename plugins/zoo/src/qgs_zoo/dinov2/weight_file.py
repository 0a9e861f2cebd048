"""Pretrained weights from a file that the user has; none are shipped or downloaded."""

from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import Tensor

from qgs.contracts import MissingExtraError
from qgs_zoo.dinov2.vit import DinoV2

SUFFIXES = (".safetensors", ".pth", ".pt")


def load_weights(vit: DinoV2, weights: str) -> None:
    """Fill `vit` from the file `weights`; raises MissingExtraError, which says what to do."""
    file = Path(weights).expanduser()
    if file.suffix not in SUFFIXES:
        raise MissingExtraError(f"{file}: weights are read from {', '.join(SUFFIXES)}")
    if not file.is_file():
        raise MissingExtraError(
            f"there are no weights at {file}: download DINOv2's, such as "
            "dinov2_vits14_pretrain.pth, and name the file in the option `weights`"
        )
    try:
        vit.load_published(_read(file))
    except Exception as error:
        # Whatever torch and safetensors raise about a damaged file.
        raise MissingExtraError(
            f"{file} does not hold the weights of a DINOv2 of width {vit.norm.weight.shape[0]} "
            f"and {len(vit.blocks)} blocks ({type(error).__name__}: {error}); give another file, "
            "or other values of `width`, `depth` and `heads`"
        ) from error


def _read(file: Path) -> Mapping[str, Tensor]:
    if file.suffix == ".safetensors":
        return load_file(file)
    # No code of strangers.
    content = torch.load(file, map_location="cpu", weights_only=True)
    for key in ("model", "state_dict"):
        content = content.get(key, content)
    return content
