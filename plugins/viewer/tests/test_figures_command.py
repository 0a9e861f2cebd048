"""`qgs figures`, on a small model with rooms of its own, and on the models in the box."""

from pathlib import Path

import pytest
from commands import run_qgs
from PIL import Image
from qgs_viewer.figures.command import NAMES
from qgs_viewer.figures.gallery import FIGURES

import qgs
from qgs.composer import resolve

SMALL = ["model.queries.count=12", "model.decoder.depth=2", "model.supervision.layers=[1,2]"]


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An untrained LocusGS with two test rooms."""
    file = tmp_path_factory.mktemp("model") / "small.safetensors"
    data = ["data.test_scenes=2", "evaluation.scenes=2"]
    qgs.save(resolve("recipes/tiny/locus.yaml", [*SMALL, *data]).build_model(), file)
    return file


def test_figures_are_written_and_explained(checkpoint: Path, tmp_path: Path) -> None:
    out = tmp_path / "figures"
    only = [word for name in ("dispersion", "curves") for word in ("--only", name)]
    done = run_qgs("figures", checkpoint, "--out", out, "--device", "cpu", *only)
    assert done.exit_code == 0, done.output
    written = {"dispersion.pdf", "dispersion.png", "figures.md"}
    assert {file.name for file in out.iterdir()} == written
    assert "![dispersion](dispersion.png)" in (out / "figures.md").read_text()
    assert tuple(FIGURES) == NAMES
    again = run_qgs("figures", checkpoint, "--out", out)
    assert isinstance(again.exception, FileExistsError)


def test_the_scene_that_was_asked_for_comes_first(checkpoint: Path) -> None:
    from qgs_viewer.figures.gallery import open_exhibition

    show = open_exhibition([str(checkpoint)], scene="test/000001")
    assert [sample.scene for sample in show.samples] == ["test/000001", "test/000000"]
    assert show.exhibits[0].sample.scene == "test/000001"


@pytest.mark.slow
def test_all_figures_of_the_models_in_the_box(tmp_path: Path) -> None:
    done = run_qgs("figures", "rooms/tokengs-64", "rooms/locus-64", "--out", tmp_path / "figures")
    assert done.exit_code == 0, done.output
    made = {file.stem for file in (tmp_path / "figures").glob("*.pdf")}
    assert made == {*FIGURES}
    for name in made:
        pixels = Image.open(tmp_path / "figures" / f"{name}.png").convert("L")
        assert pixels.width > 1400
        assert len(set(pixels.resize((64, 64)).tobytes())) > 20
