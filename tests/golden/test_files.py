"""Golden files pass the comparison with the published code, tensor by tensor, unless changed."""

from pathlib import Path

import parity
import torch
from published.files import read_golden

FILES = {path.stem: path for path in Path(__file__).parent.glob("*.safetensors")}
INPUTS = """
alphas_pred c2w has_mask images_gt images_pred intrinsics masks_gt opacity points rgb target_time
times tuned_latents
"""
"""Of files of models and of losses."""


def compared_names(golden):
    """The tensors of a file that are neither inputs nor weights."""
    names = [name for name in golden.tensors if not name.startswith("weights.")]
    return [name for name in names if name not in INPUTS.split()]


def test_every_tensor_of_the_golden_files():
    assert len(FILES) == 13
    for path in FILES.values():
        golden = read_golden(path)
        rows = parity.compared(golden)
        assert not [row for row in rows if row.problem]
        assert [row.name for row in rows] == compared_names(golden)


STRAYS = {
    "locus_full_a": "expected",
    "tokengs_a": "anchor_center.0",
    "tokengs_latent_a": "tokens.3",
    "loss_a": "expected.tokengs.nossim.loss_lpips",
}


def test_altered_and_added_tensors_fail_by_name_and_others_pass():
    """In float64."""
    for source, stray in STRAYS.items():
        golden = read_golden(FILES[source])
        tensors = golden.tensors
        expected = {stray: "not compared: nothing here has this name"}
        for name, tensor in tensors.items():
            tensors[name] = tensor.double() if tensor.is_floating_point() else tensor
        for name in compared_names(golden)[::2]:
            last = tuple(tensors[name].isfinite().nonzero()[-1])
            tensors[name][last] += 1e-3 + 1e-3 * tensors[name][last].abs()
            expected[name] = f"1 of {tensors[name].numel()} beyond tolerance"
        tensors[stray] = torch.zeros(2)
        rows = parity.compared(golden)
        assert {row.name: row.problem for row in rows if row.problem} == expected
