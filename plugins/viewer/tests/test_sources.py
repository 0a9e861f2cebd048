import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement
from qgs_viewer.files import read_ply
from qgs_viewer.sources import FixedSource, ModelSource, Wanted, open_source
from small import VIEWS, Walk, model_of

import qgs
from qgs.analysis.reconstruction import choose_sample, reconstruct, write_reconstruction
from qgs.io.ply import write_ply


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `qgs reconstruct` leaves, by a model whose checkpoint lies beside it."""
    folder, model = tmp_path_factory.mktemp("finished"), model_of("locus")
    qgs.save(model, folder / "model.safetensors")
    sample, world = choose_sample(Walk(), VIEWS, 2, (1, 4), (2, 3))
    result = reconstruct(model, sample, world)
    result = replace(result, model=str(folder / "model.safetensors"))
    write_reconstruction(model, result, folder / "scene")
    return folder


def test_a_finished_reconstruction_has_its_queries(finished: Path) -> None:
    source = open_source(str(finished / "scene"), Wanted())
    assert isinstance(source, ModelSource)
    assert (list(source.frames), source.notes) == ([0, 1], ())
    assert source.labels[0] == "0 (photos/01.png)"
    look, ply = source.look(source.frames), read_ply(finished / "scene/gaussians.ply")
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


def test_a_ply_comes_back_as_it_was_written(tmp_path: Path) -> None:
    gaussians = model_of("tokengs")(source_views()).gaussians
    write_ply(gaussians, tmp_path / "a.ply")
    found = read_ply(tmp_path / "a.ply")
    for name in ("means", "scales", "opacities", "colors"):
        torch.testing.assert_close(getattr(found, name), getattr(gaussians, name).detach())
    source = open_source(str(tmp_path / "a.ply"), Wanted())
    assert source.look(()).gaussians.count == gaussians.count


def source_views() -> qgs.Views:
    scene = Walk()
    cameras = scene.cameras[[1, 4]]
    return qgs.Views(scene.images([1, 4])[None], cameras.to(torch.float32)[None])


def test_a_ply_of_another_tool_has_more_and_other_columns(tmp_path: Path) -> None:
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", *[f"f_rest_{i}" for i in range(45)]]
    names += ["opacity", *[f"scale_{i}" for i in range(3)], *[f"rot_{i}" for i in range(4)]]
    table = np.zeros(2, dtype=[(name, "<f4") for name in names])
    table["rot_0"], table["rot_3"], table["f_dc_1"] = 3.0, 4.0, 1.7724539
    PlyData([PlyElement.describe(table, "vertex")]).write(str(tmp_path / "b.ply"))
    found = read_ply(tmp_path / "b.ply")
    torch.testing.assert_close(found.quats[0, 0], torch.tensor([0.6, 0, 0, 0.8]))
    torch.testing.assert_close(found.colors[0, 0], torch.tensor([0.5, 1.0, 0.5]))
    assert found.opacities[0].tolist() == [0.5, 0.5]
    assert found.scales[0, 0].tolist() == [1, 1, 1]


@pytest.mark.parametrize(
    ("fill", "said"),
    [(b"no ply", "no whole PLY"), ("x y z", "lack scale_0"), ("nan", "not finite")],
)
def test_what_holds_no_gaussians_is_refused(tmp_path: Path, fill: bytes | str, said: str) -> None:
    path = tmp_path / "c.ply"
    if isinstance(fill, bytes):
        path.write_bytes(fill)
    elif fill == "nan":
        gaussians = model_of("tokengs")(source_views()).gaussians
        write_ply(gaussians, path)
        data = PlyData.read(str(path))
        table = np.array(data["vertex"].data)
        table["x"][0] = np.nan
        PlyData([PlyElement.describe(table, "vertex")]).write(str(path))
    else:
        table = np.zeros(2, dtype=[(name, "<f4") for name in fill.split()])
        PlyData([PlyElement.describe(table, "vertex")]).write(str(path))
    with pytest.raises(ValueError, match=said):
        read_ply(path)


def test_options_that_say_nothing_to_a_ply_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="a PLY file, to which photos, frames says nothing"):
        open_source(str(tmp_path / "a.ply"), Wanted(photos="x", frames="1"))
