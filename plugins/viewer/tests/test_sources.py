import json
import shutil
from pathlib import Path

import pytest
import torch
from qgs_viewer.look import NEUTRAL
from qgs_viewer.sources import ModelSource, Wanted, open_source
from small import QUERIES, VIEWS, Walk, model_of

import qgs
from qgs.analysis.reconstruction import choose_sample, reconstruct_sample
from qgs.composer import resolve
from qgs.contracts import ViewsConfig
from qgs.io.gaussians import load_ply
from qgs.model import QueryGaussianModel


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `qgs reconstruct` leaves, by a model whose checkpoint lies beside it."""
    folder = tmp_path_factory.mktemp("finished")
    qgs.save(model_of("locus"), folder / "model.safetensors")
    model = qgs.load(folder / "model.safetensors")
    sample, world = choose_sample(Walk(), VIEWS, 2, (1, 4), (2, 3))
    reconstruct_sample(model, sample, world).save(folder / "scene")
    return folder


BY_DISTANCE = VIEWS.model_copy(update={"scale": "distance", "scale_factor": 0.7})


def finished_by_distance(folder: Path, views: ViewsConfig) -> QueryGaussianModel:
    """A model of a recipe with BY_DISTANCE, and in folder/scene what it made of frames 1 and 4.

    views: how they were brought into its world.
    """
    torch.manual_seed(0)
    changes = [f"model.queries.count={QUERIES}", "views.scale=distance", "views.scale_factor=0.7"]
    qgs.save(
        resolve("recipes/tiny/locus.yaml", changes).build_model().eval(),
        folder / "model.safetensors",
    )
    model = qgs.load(folder / "model.safetensors")
    sample, world = choose_sample(Walk(), views, 2, (1, 4), (0, 2, 3, 5))
    reconstruct_sample(model, sample, world).save(folder / "scene")
    return model


def test_a_finished_reconstruction_has_its_queries(finished: Path) -> None:
    source = open_source(str(finished / "scene"), Wanted())
    assert isinstance(source, ModelSource)
    assert (list(source.frames), [*source.notes]) == ([0, 1], [])
    assert list(source.labels) == [f"photos/0{frame}.png" for frame in (1, 4, 2, 3)]
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
        ({"model": ""}, "no model"),
        ({"tuning": {"steps": 3}}, "tuned"),
        ({"tuning": {"steps": 3}, "refinement": {"steps": 3}}, "refined"),
        ({"model": "gone/model.safetensors"}, "gone/model.safetensors"),
    ],
)
def test_without_its_model_it_is_shown_as_it_is(
    finished: Path, tmp_path: Path, record: dict[str, object], said: str
) -> None:
    source = open_source(str(changed_copy(finished, tmp_path, **record)), Wanted())
    assert not isinstance(source, ModelSource)
    assert said in source.notes[0]
    look = source.look(source.frames)
    assert (look.queries, look.support(0)) == (0, None)
    assert look.views is not None
    assert look.views.images.shape[1] == 2


def test_a_reconstruction_keeps_its_background(finished: Path, tmp_path: Path) -> None:
    folder = changed_copy(finished, tmp_path, model="", background=[0.0, 0.5, 1.0])
    assert open_source(str(folder), Wanted()).look(()).background == (0.0, 0.5, 1.0)
    told = json.loads((finished / "scene/cameras.json").read_text())
    assert told["background"] == [0.5, 0.5, 0.5]
    (folder / "cameras.json").write_text(json.dumps({k: told[k] for k in ("scene", "views")}))
    assert open_source(str(folder), Wanted()).look(()).background == NEUTRAL
    (folder / "cameras.json").write_text(json.dumps({**told, "background": [0.5]}))
    with pytest.raises(ValueError, match=r"cameras\.json is no record"):
        open_source(str(folder), Wanted())


def test_a_ply_shows_gaussians_alone(finished: Path) -> None:
    source = open_source(str(finished / "scene/gaussians.ply"), Wanted())
    found = source.look(())
    assert (found.queries, found.views) == (0, None)
    assert found.gaussians.count == load_ply(finished / "scene/gaussians.ply").count


def test_changed_inputs_have_the_scale_of_their_own_distance(tmp_path: Path) -> None:
    model = finished_by_distance(tmp_path, BY_DISTANCE)
    source = open_source(str(tmp_path / "scene"), Wanted())
    assert isinstance(source, ModelSource)
    frames = [source.labels.index(f"photos/0{frame}.png") for frame in (1, 2)]
    seen = source.look(frames).views
    true = ModelSource(model, Walk(), BY_DISTANCE, (1, 4), "of the photos").look((1, 2)).views
    assert seen is not None
    assert true is not None
    torch.testing.assert_close(seen.cameras.c2w, true.cameras.c2w, atol=1e-4, rtol=1e-4)


def test_a_model_is_not_fetched_on_the_word_of_a_file(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []
    monkeypatch.setattr("qgs_viewer.sources.CheckpointFile", asked.append)
    url = "https://example.org/model.safetensors"
    source = open_source(str(changed_copy(finished, tmp_path, model=url)), Wanted())
    assert f"`qgs view {url} PHOTOS`" in source.notes[0]
    assert asked == []
