"""Every golden file passes the comparison with the published code, tensor by tensor."""

from pathlib import Path

import parity
import pytest
from safetensors import safe_open

GOLDEN = Path(__file__).parent
FILES = sorted(GOLDEN.glob("*.safetensors"))
VARIANTS = (
    "anchor_offset", "center_only_bias", "content_cross_attn", "content_self_attn",
    "free_center", "full", "no_radius_state", "static_radius",
)  # fmt: skip
OPTIONAL_INPUTS = {"tuned_latents", "times", "target_time"}
INPUTS = {"c2w", "intrinsics", "rgb"}
LOSS_INPUTS = {
    "alphas_pred", "c2w", "has_mask", "images_gt", "images_pred", "intrinsics", "masks_gt",
    "opacity", "points",
}  # fmt: skip


def test_the_published_files_are_all_here() -> None:
    names = [*(f"locus_{variant}_a" for variant in VARIANTS), "loss_a", "tokengs_a"]
    names += [f"tokengs_{kind}_a" for kind in ("dynamic", "latent", "multiscale")]
    assert [path.stem for path in FILES] == sorted(names)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_every_tensor_of_a_golden_file(path: Path) -> None:
    rows = parity.rows_of(path)
    assert [row for row in rows if row.problem] == []
    inputs = LOSS_INPUTS if path.stem == "loss_a" else {*INPUTS, *OPTIONAL_INPUTS}
    with safe_open(path, "pt") as file:
        compared = {name for name in file.keys() if not name.startswith("weights.")} - inputs  # noqa: SIM118
    assert {row.name for row in rows} == compared
