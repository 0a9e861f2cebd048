import json
import shutil
from pathlib import Path

import pytest
from qgs_viewer.sources import FixedSource, ModelSource, Wanted, open_source
from small import VIEWS, Walk, model_of

import qgs
from qgs.analysis.reconstruction import choose_sample, reconstruct, write_reconstruction
from qgs.io.ply import load_ply


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `qgs reconstruct` leaves, by a model whose checkpoint lies beside it."""
    folder = tmp_path_factory.mktemp("finished")
    qgs.save(model_of("locus"), folder / "model.safetensors")
    model = qgs.load(folder / "model.safetensors")
    sample, world = choose_sample(Walk(), VIEWS, 2, (1, 4), (2, 3))
    result = reconstruct(model, sample, world)
    write_reconstruction(model, result, folder / "scene")
    return folder


def test_a_finished_reconstruction_has_its_queries(finished: Path) -> None:
    source = open_source(str(finished / "scene"), Wanted())
    assert isinstance(source, ModelSource)
    assert (list(source.frames), source.notes) == ([0, 1], ())
    assert source.labels[0] == "0 (photos/01.png)"
    look, ply = source.look(source.frames), load_ply(finished / "scene/gaussians.ply")
    assert look.support(1) is not None
    spread = (ply.means - ply.means.mean(1, keepdim=True)).norm(dim=-1).mean()
    far = (look.gaussians.means - ply.means).norm(dim=-1).median()
    assert far < 0.01 * spread  # its photos lost what 8 bits lose
    changed = source.look((0, 1, 2))
    assert len(changed.labels) == 3


def changed_copy(finished: Path, tmp_path: Path, **record: object) -> Path:
    folder = Path(shutil.copytree(finished / "scene", tmp_path / "scene"))
    told = json.loads((folder / "cameras.json").read_text())
    (folder / "cameras.json").write_text(json.dumps({**told, **record}))
    return folder


@pytest.mark.parametrize(
    ("record", "said"),
    [
        ({"model": ""}, "does not tell its model"),
        ({"tuning": {"steps": 3}}, "tuned or refined"),
        ({"model": "gone/model.safetensors"}, "is not there"),
    ],
)
def test_without_its_model_it_is_shown_as_it_is(
    finished: Path, tmp_path: Path, record: dict[str, object], said: str
) -> None:
    source = open_source(str(changed_copy(finished, tmp_path, **record)), Wanted())
    assert isinstance(source, FixedSource)
    assert said in source.notes[0]
    look = source.look(source.frames)
    assert (look.queries, look.support(0)) == (0, None)
    assert look.views is not None
    assert look.views.images.shape[1] == 2


def test_another_model_of_the_name_is_noticed(finished: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.safetensors"
    qgs.save(model_of("tokengs"), other)
    source = open_source(str(changed_copy(finished, tmp_path, model=str(other))), Wanted())
    assert "makes other Gaussians" in source.notes[0]


@pytest.mark.parametrize("text", ["{", '{"views": []}', '{"scene": "x", "views": [{"kind": 1}]}'])
def test_a_broken_record_is_told_with_its_file(finished: Path, tmp_path: Path, text: str) -> None:
    folder = changed_copy(finished, tmp_path)
    (folder / "cameras.json").write_text(text)
    with pytest.raises(ValueError, match=r"cameras\.json is no record of a reconstruction"):
        open_source(str(folder), Wanted())


def test_a_missing_picture_is_told(finished: Path, tmp_path: Path) -> None:
    folder = changed_copy(finished, tmp_path)
    (folder / "views/00001_input.png").unlink()
    with pytest.raises(FileNotFoundError, match="00001_input"):
        open_source(str(folder), Wanted())


def test_a_ply_shows_gaussians_alone(finished: Path) -> None:
    source = open_source(str(finished / "scene/gaussians.ply"), Wanted())
    found = source.look(())
    assert (found.queries, found.views) == (0, None)
    assert found.gaussians.count == load_ply(finished / "scene/gaussians.ply").count


def test_options_that_say_nothing_to_a_ply_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="a PLY file, to which photos, frames says nothing"):
        open_source(str(tmp_path / "a.ply"), Wanted(photos="x", frames="1"))
