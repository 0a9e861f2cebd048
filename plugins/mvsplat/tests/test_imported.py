"""Files in the published layouts: `qgs import --recipe auto` makes models that are exact."""

from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from commands import run_qgs
from published.comparison import ATOL, RTOL
from published.files import GoldenFile, read_golden
from published.splats import views_of, weights_of
from qgs_published.importing import PublishedError, import_weights
from torch import Tensor

import qgs
from qgs.geometry.harmonics import SH_C0, harmonics
from qgs.geometry.transforms import quat_to_matrix
from qgs.types import Gaussians

GOLDEN = Path(__file__).parent / "golden"
DIRECTIONS = F.normalize(torch.randn(50, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
FILES = [("mvsplat_views3_a", False), ("mvsplat_views3_a", True)]
FILES += [("depthsplat_a", True), ("depthsplat_base_eighth_a", False)]
"""Names of golden files, and whether theirs is a bare state dict or a checkpoint of Lightning."""


def imported(golden: GoldenFile, folder: Path, bare: bool) -> qgs.QueryGaussianModel:
    """The model of a file such as the release publishes."""
    weights = {f"encoder.{name}": x for name, x in weights_of(golden).items()}
    file, out = folder / "published.ckpt", folder / "model.safetensors"
    torch.save(weights if bare else {"state_dict": weights, "epoch": 3}, file)
    done = run_qgs("import", file, "--recipe", "auto", "--out", out)
    assert done.exit_code == 0, done.output
    assert f"{len(weights)} tensors used" in done.output
    model = qgs.load(out).eval()
    assert sum(x.numel() for x in model.state_dict().values()) == golden.config["num_parameters"]
    return model


def outputs(found: Gaussians) -> dict[str, Tensor]:
    """What golden files have of Gaussians, colours in 50 directions in place of harmonics."""
    factors = quat_to_matrix(found.quats) * found.scales[..., None, :]
    assert found.sh is not None
    varying = harmonics(DIRECTIONS, found.sh.shape[-2]) @ found.sh
    return {
        "means": found.means,
        "covariances": factors @ factors.mT,
        "opacities": found.opacities,
        "colours": found.colors[..., None, :] + varying,
    }


def released_colours(coefficients: Tensor) -> Tensor:
    """Colours (..., 50, 3) of (..., 3, K): the family's rasteriser reads directions as z, x, y."""
    read = coefficients[..., 1:16]  # degree 4 is never read
    varying = harmonics(DIRECTIONS[:, [2, 0, 1]], read.shape[-1]) @ read.mT
    return 0.5 + SH_C0 * coefficients[..., None, :, 0] + varying


@pytest.mark.parametrize(("name", "bare"), FILES)
def test_an_imported_file_gives_the_released_gaussians(
    tmp_path: Path, name: str, bare: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the whole model and its recipe, in worlds in which no camera stands at the origin."""
    golden = read_golden(GOLDEN / f"{name}.safetensors")
    model, views = imported(golden, tmp_path, bare), views_of(golden)
    assert (views.cameras.c2w[0, 0] - torch.eye(4)).abs().max() > 0.3
    # near and far of the files differ from view to view
    near, far, own = golden.input("near"), golden.input("far"), model.encoder.predict
    monkeypatch.setattr(model.encoder, "predict", lambda given, *_: own(given, near, far))
    done = model.reconstruct(views, overrides=["views.scale=constant"])
    assert torch.equal(done.sample.inputs.cameras.c2w, views.cameras.c2w)
    found = outputs(done.gaussians)
    expected = {**golden.tensors, "colours": released_colours(golden.tensors["harmonics"])}
    wrong = {
        key: float((x - expected[key]).abs().max())
        for key, x in found.items()
        if not torch.allclose(x, expected[key], rtol=RTOL, atol=ATOL)
    }
    assert wrong == {}


@pytest.mark.parametrize("change", ["missing", "foreign"])
def test_every_tensor_is_needed_and_known(tmp_path: Path, change: str) -> None:
    weights = {
        f"encoder.{name}": x
        for name, x in weights_of(read_golden(GOLDEN / "mvsplat_views3_a.safetensors")).items()
    }
    name = "encoder.depth_predictor.to_disparity.2.bias"
    if change == "missing":
        del weights[name]
    else:
        name = "encoder.depth_predictor.to_disparity.3.bias"
        weights[name] = torch.zeros(2)
    file, out = tmp_path / "file.ckpt", tmp_path / "model.safetensors"
    torch.save(weights, file)
    with pytest.raises(PublishedError, match=name.replace(".", r"\.")):
        import_weights(file, None, out)
    assert not out.exists()
