"""Published weights to import: those of the golden files."""

from pathlib import Path

from safetensors import safe_open
from torch import Tensor


def published(name: str) -> dict[str, Tensor]:
    """The state dict in a golden file, such as "locus_full_a"; a new mapping each time."""
    with safe_open(Path(__file__).parent / "golden" / f"{name}.safetensors", "pt") as file:
        prefix, names = "weights.", list(file.keys())
        weights = {n.removeprefix(prefix): n for n in names if n.startswith(prefix)}
        return {name: file.get_tensor(stored) for name, stored in weights.items()}
