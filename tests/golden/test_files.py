"""Every golden file passes the comparison with the published code, tensor by tensor."""

import parity
import pytest
from golden.files import GOLDEN, compared_names
from published.files import read_golden

VARIANTS = (
    "anchor_offset", "center_only_bias", "content_cross_attn", "content_self_attn",
    "free_center", "full", "no_radius_state", "static_radius"
)  # fmt: skip
FILES = [*(f"locus_{variant}_a" for variant in VARIANTS), "loss_a", "tokengs_a"]
FILES += [f"tokengs_{kind}_a" for kind in ("dynamic", "latent", "multiscale")]


def test_the_published_files_are_all_here():
    assert sorted(path.stem for path in GOLDEN.glob("*.safetensors")) == FILES


@pytest.mark.parametrize("name", FILES)
def test_every_tensor_of_a_golden_file(name):
    golden = read_golden(GOLDEN / f"{name}.safetensors")
    rows = parity.rows_of(GOLDEN / f"{name}.safetensors")
    assert [row for row in rows if row.problem] == []
    assert [row.name for row in rows] == compared_names(golden)
