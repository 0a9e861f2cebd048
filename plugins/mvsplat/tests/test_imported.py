"""Files in the published layouts: `qgs import --recipe auto` makes models that are exact."""

from pathlib import Path

import pytest
import torch
from commands import run_qgs
from published.comparison import ATOL, RTOL
from published.files import GoldenFile, read_golden
from published.splats import views_of, weights_of
from qgs_published.importing import PublishedError, import_weights
from torch import Tensor

import qgs
from qgs.geometry.harmonics import SH_C0
from qgs.geometry.transforms import quat_to_matrix
from qgs.types import ImageMemory

GOLDEN = Path(__file__).parent / "golden"
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


@torch.no_grad()
def outputs(model: qgs.QueryGaussianModel, golden: GoldenFile) -> dict[str, Tensor]:
    """Gaussians between the file's own near and far, which differ from view to view."""
    views = views_of(golden)
    numbers = model.encoder.predict(views, golden.input("near"), golden.input("far"))
    grid = (numbers.shape[1], *views.cameras.size)
    memory = ImageMemory(numbers.permute(0, 1, 3, 4, 2).flatten(1, 3), grid=grid)
    found = model.predict(views, memory, model.queries(memory, views)).gaussians
    factors = quat_to_matrix(found.quats) * found.scales[..., None, :]
    return {
        "means": found.means,
        "covariances": factors @ factors.mT,
        "opacities": found.opacities,
        "colours": (found.colors - 0.5) / SH_C0,
    }


@pytest.mark.parametrize(("name", "bare"), FILES)
def test_an_imported_file_gives_the_released_gaussians(
    tmp_path: Path, name: str, bare: bool
) -> None:
    golden = read_golden(GOLDEN / f"{name}.safetensors")
    found = outputs(imported(golden, tmp_path, bare), golden)
    expected = {**golden.tensors, "colours": golden.tensors["harmonics"][..., 0]}
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
