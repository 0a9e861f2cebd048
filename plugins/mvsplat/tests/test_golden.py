"""MVSplat and DepthSplat against tensors that the released code computed."""

from importlib.util import find_spec, module_from_spec
from pathlib import Path

import parity
import pytest
import torch
from published.files import read_golden
from published.splats import views_of
from qgs_mvsplat import sweep
from qgs_mvsplat.adapter import e3nn_harmonics, world_harmonics
from qgs_mvsplat.depthsplat import nearest_neighbours
from qgs_mvsplat.sweep import feature_lenses, relative_poses
from torch._subclasses.fake_tensor import FakeTensorMode

from qgs.geometry.harmonics import harmonics

GOLDEN = Path(__file__).parent / "golden"
FILES = [
    *("mvsplat_a", "mvsplat_views3_a", "mvsplat_cases_a"),
    *("depthsplat_a", "depthsplat_base_a", "depthsplat_base_eighth_a"),
    *("depthsplat_small_eighth_views4_a", "depthsplat_cases_a"),
]


def directions(count: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    drawn = torch.randn(count, 3, dtype=torch.float64, generator=generator)
    return torch.nn.functional.normalize(drawn, dim=-1)


@pytest.mark.parametrize("name", FILES)
def test_every_tensor(name: str) -> None:
    path = GOLDEN / f"{name}.safetensors"
    rows = parity.rows_of(path)
    assert [row for row in rows if row.problem] == []
    # The release's data loader crops to whole pixels; sources of photos here do not.
    outputs = read_golden(path).config["outputs"]
    models = {name for name in outputs if not name.startswith(("crop.", "patch."))}
    assert {row.name for row in rows} == models


def test_a_changed_tensor_is_found(tmp_path: Path) -> None:
    golden = read_golden(GOLDEN / "mvsplat_cases_a.safetensors")
    golden.tensors["adapter.means"][3, 1] += 2e-3
    assert [row.name for row in parity.compared(golden) if row.problem] == ["adapter.means"]


def test_our_harmonics_show_the_colours_of_the_released_ones() -> None:
    # Their rasteriser evaluates 3DGS's functions at (z, x, y), of degrees up to 3.
    given = read_golden(GOLDEN / "mvsplat_cases_a.safetensors").tensors
    rotation = given["adapter.extrinsics"][:, :3, :3].double()
    released = given["adapter.harmonics"].double()
    raw = given["adapter.raw"][:, 7:].double().unflatten(1, (3, -1))
    ours = torch.einsum("bkl,bxl->bxk", world_harmonics(rotation, 4), raw)
    seen = directions(50)
    theirs = harmonics(seen[:, [2, 0, 1]], 15) @ released[..., 1:16].mT
    shown = harmonics(seen, 15) @ ours[..., 1:16].mT
    torch.testing.assert_close(shown, theirs, rtol=1e-4, atol=5e-5)
    torch.testing.assert_close(ours[..., 0], released[..., 0], rtol=1e-5, atol=1e-6)
    assert theirs.std() > 0.01


def test_harmonics_are_orthonormal_and_those_of_3dgs_but_for_signs_and_axes() -> None:
    values = e3nn_harmonics(directions(40_000), 4)
    gram = values.mT @ values / len(values)
    torch.testing.assert_close(gram, torch.eye(25, dtype=torch.float64), rtol=0, atol=0.06)
    sign = (-1.0) ** torch.arange(1, 16)
    ours = harmonics(directions(40_000)[:, [2, 0, 1]], 15) * (4 * torch.pi) ** 0.5
    torch.testing.assert_close(ours, sign * values[:, 1:16])
    torch.testing.assert_close(values[:, 1:4], 3**0.5 * directions(40_000))


def test_both_ways_to_correlate_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few pixels for each candidate: all pairs at once; many: warped features, in chunks."""
    golden = read_golden(GOLDEN / "depthsplat_a.safetensors")
    cameras, features = views_of(golden).cameras, golden.tensors["features_mv.0"]
    neighbours = nearest_neighbours(cameras.c2w, 2)
    inverse = golden.tensors["inverse_depth_candidates.0"][..., None, None]
    lens = feature_lenses(cameras, features.shape[-2:])
    rest = (inverse, lens, relative_poses(cameras.c2w, neighbours), neighbours)

    def found() -> tuple[torch.Tensor, torch.Tensor]:
        learned = features.clone().requires_grad_()
        volume = sweep.cost_volume(learned, *rest)
        return volume, torch.autograd.grad(volume.square().sum(), learned)[0]

    gradient = found()[1]  # of all at once
    for pairs, samples in ((0, 1 << 15), (40, 1 << 10)):
        monkeypatch.setattr(sweep, "PAIRS", pairs)
        monkeypatch.setattr(sweep, "MAX_SAMPLES", samples)
        volume, own = found()
        # Sums cancel: twice the rounding of the released code's own.
        torch.testing.assert_close(volume, golden.tensors["cost_volume.0"], rtol=1e-4, atol=1.5e-4)
        torch.testing.assert_close(own, gradient, rtol=1e-4, atol=1.5e-4 * gradient.abs().max())


def test_a_pass_on_shapes_or_in_inference_leaves_nothing_for_others() -> None:
    """In a module of its own, which no other test has used before."""
    spec = find_spec("qgs_mvsplat.adapter")
    assert spec is not None
    assert spec.loader is not None
    with torch.inference_mode():
        fresh = module_from_spec(spec)
        spec.loader.exec_module(fresh)
        fresh.world_harmonics(torch.eye(3), 2)
    with FakeTensorMode(allow_non_fake_inputs=True):
        fresh.world_harmonics(torch.eye(3), 2)
    rotation = torch.linalg.matrix_exp(torch.tensor([[0.0, 1, 2], [-1, 0, 3], [-2, -3, 0]]))
    rotation.requires_grad_()
    fresh.world_harmonics(rotation, 2).sum().backward()
    assert torch.equal(fresh.world_harmonics(rotation, 2), world_harmonics(rotation, 2))
