import html
import json
import re
import shlex
import shutil
from pathlib import Path

import pytest
import yaml
from commands import MODEL, run_qgs
from photo_formats import noisy_photos
from plyfile import PlyData
from qgs_viewer.contest import checkpoints, judge, report_of, resolve_fairly
from qgs_viewer.curves import curves_of
from qgs_viewer.demo import ON_PHOTOS, new_folder, show_trained

import qgs
from qgs.composer import resolve
from qgs.data.domain import KEY
from qgs.data.stream import trained_domain

RECIPE = {
    "recipe": 1,
    "model": MODEL,
    "plugins": ["rooms"],
    "data": {"type": "rooms/procedural", "image_size": [16, 16], "scenes": 4, "test_scenes": 3},
    "views": {"inputs": 2, "targets": 2, "gap": [2, 4], "scale_factor": 0.4},
    "optimizer": {"warmup": 5},
    "training": {"batch_size": 2, "precision": "float32"},
    "evaluation": {"scenes": 2},
}


@pytest.fixture
def recipes(tmp_path):
    """Two recipes that differ in the number of queries."""
    (tmp_path / "few.yaml").write_text(yaml.safe_dump(RECIPE))
    overlay = {"recipe": 1, "extends": "few.yaml", "model": {"queries": {"count": 12}}}
    (tmp_path / "more.yaml").write_text(yaml.safe_dump(overlay))
    return [tmp_path / "few.yaml", tmp_path / "more.yaml"]


@pytest.mark.slow
def test_recipes_are_trained_compared_and_reported(recipes, tmp_path):
    out = tmp_path / "demo"
    result = run_qgs("demo", "--train", *recipes, "--seconds", 1, "--out", out)
    assert result.exception is None
    for name, queries in (("few", 8), ("more", 12)):
        assert (out / name / "checkpoint.safetensors").is_file()
        assert PlyData.read(out / name / "example.ply")["vertex"].count == 4 * queries
    page = (out / "report.html").read_text()
    assert page.count("data:image/png;base64,") > 10
    assert not re.search(r"(src|href)=\"(?!data:|#)", page)
    assert "count: 12" in page


def test_recipes_with_other_data_are_not_compared(recipes):
    assert [*resolve_fairly([recipes[0]] * 2, seconds=1, seed=0)] == ["few", "few (2)"]
    overlay = {"recipe": 1, "extends": "few.yaml", "views": {"gap": [2, 5]}}
    recipes[1].write_text(yaml.safe_dump(overlay))
    with pytest.raises(ValueError, match="more and few differ in views"):
        resolve_fairly(recipes, seconds=1, seed=0)


def test_all_systems_can_be_compared():
    """Though C3G trains on its input views and tuning would tune other things."""
    names = ("tokengs", "locus", "ellipsoid", "gslrm", "c3g", "globalsplat", "tokengs_latent")
    compared = resolve_fairly([Path(f"tiny/{n}.yaml") for n in names], seconds=1, seed=0)
    assert [*compared] == [*names]
    assert compared["c3g"].training.judge_inputs


@pytest.fixture(scope="module")
def domain():
    """What the views of RECIPE are like: it takes a second."""
    recipe = resolve(RECIPE)
    return trained_domain(recipe.build_data(), recipe.views, recipe.seed).text


@pytest.fixture
def models(tmp_path, monkeypatch, domain):
    """Two stand-ins for trained models that know on what views they were trained."""
    monkeypatch.chdir(tmp_path)
    files = []
    for name, queries in (("few", 8), ("more", 12)):
        recipe = resolve(RECIPE, [f"model.queries.count={queries}"])
        file = tmp_path / "models" / f"{name}.safetensors"
        qgs.save(recipe.build_model(), file, extra={KEY: domain, "step": "7000"})
        files += ["--model", f"models/{name}.safetensors"]
    return files


def test_trained_models_are_shown_on_rooms_they_never_saw(models, tmp_path):
    result = run_qgs("demo", *models)
    assert result.exit_code == 0, result.output
    for name, queries in (("few", 8), ("more", 12)):
        ply = tmp_path / "demo" / name / "example.ply"
        assert PlyData.read(ply)["vertex"].count == 4 * queries
        assert not (ply.parent / "checkpoint.safetensors").exists()
    page = (tmp_path / "demo" / "report.html").read_text()
    assert "test/000001" in page
    assert "few: step 7,000 of 150,000; more: step 7,000 of 150,000" in page
    assert "<h2>Training</h2>" not in page


def test_a_report_of_runs_shows_how_they_were_trained(models, tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    (run / "checkpoint.safetensors").write_bytes((tmp_path / models[1]).read_bytes())
    steps = [{"step": n, "seconds": n / 2, "loss": 1 / n, "psnr": 10.0 + n} for n in range(1, 9)]
    (run / "history.jsonl").write_text("".join(json.dumps(step) + "\n" for step in steps))
    result = run_qgs("report", "run", models[3])
    assert result.exit_code == 0, result.output
    page = (tmp_path / "report" / "report.html").read_text()
    assert "<h2>Training</h2>" in page
    photos = noisy_photos(tmp_path / "mine", 6, step=0.1)
    assert run_qgs("report", "run", "--photos", photos).exit_code == 0
    assert "<h2>Your photos</h2>" in (tmp_path / "report-2" / "report.html").read_text()


def test_a_checkpoint_has_a_history_of_its_own_or_of_its_run(tmp_path):
    def write(name, step):
        record = {"step": step, "seconds": 1.0, "loss": 1.0, "psnr": 9.0}
        (tmp_path / name).write_text(json.dumps(record) + "\n")

    own, other = (tmp_path / f"{name}.safetensors" for name in ("own", "other"))
    write("own.history.jsonl", 1)
    assert curves_of(own).steps == [1]
    assert curves_of(other) is None
    write("history.jsonl", 2)
    assert [curves_of(file).steps for file in (own, other)] == [[1], [2]]


def test_photos_in_another_unit_are_judged_alike(models, tmp_path):
    figures = []
    for name, unit in (("a", 0.01), ("b", 7.0)):
        photos = noisy_photos(tmp_path / name, 12, step=unit)
        entry = judge(checkpoints(models[1:2]), str(photos), "cpu")[0]
        figures.append(entry.evaluation.means()["psnr"])
        assert entry.recipe.views.scale == "search"
    assert figures[0] == pytest.approx(figures[1], abs=1e-3)


def test_small_scenes_keep_their_photos_and_others_every_eighth(models, tmp_path):
    for name, count in (("large", 20), ("small", 3), ("tiny", 2)):
        noisy_photos(tmp_path / "scenes" / name, count, step=0.1)
    evaluation = judge(checkpoints(models[1:2]), str(tmp_path / "scenes"), "cpu")[0].evaluation
    judged = {
        score.scene: {f for _, compared in score.views for f in compared}
        for score in evaluation.scores
    }
    assert judged == {"large": {4, 12}, "small": {1}}
    assert [missing.scene for missing in evaluation.missing] == ["tiny"]


def test_two_photos_leave_nothing_to_compare_with(models, tmp_path):
    result = run_qgs("demo", noisy_photos(tmp_path / "two", 2, step=0.1), *models)
    assert isinstance(result.exception, ValueError)
    assert "none is left to compare with" in str(result.exception)
    assert not (tmp_path / "demo").exists()


def test_a_model_tuned_on_the_photos_is_compared_on_those_it_never_saw(models, tmp_path):
    photos = noisy_photos(tmp_path / "mine", 20, step=0.1)
    data = {"type": "qgs/photos", "path": str(photos), "image_size": [16, 16], "holdout": 5}
    views = {**RECIPE["views"], "gap": [1, 3], "scale": "auto"}
    file = tmp_path / "models/tuned.safetensors"
    qgs.save(resolve({**RECIPE, "data": data, "views": views}).build_model(), file)
    before, after = judge(checkpoints([models[1], str(file)]), str(photos), "cpu")
    judged = [[score.views for score in entry.evaluation.scores] for entry in (before, after)]
    assert judged[0] == judged[1]
    compared = {frame for views in judged[0] for _, frames in views for frame in frames}
    assert compared <= {2, 7, 12, 17}
    assert [entry.recipe.views.scale for entry in (before, after)] == ["search", "auto"]
    report = report_of([before, after], "", {}, {})
    ends = [own.samples[0].inputs.cameras.c2w[0, -1, :3, 3].norm() for own in report.contenders]
    assert ends[0] != ends[1]


@pytest.mark.parametrize(("size", "side"), [(None, 128), ("128x192", 128), ("64x64", 64)])
def test_photos_meet_models_of_their_size(tmp_path, monkeypatch, size, side):
    def none_of(models):
        raise FileNotFoundError(" ".join(models))

    monkeypatch.setattr("qgs_viewer.contest.checkpoints", none_of)
    with pytest.raises(FileNotFoundError, match=f"^{' '.join(ON_PHOTOS[side])}(\\n|$)"):
        show_trained(None, str(tmp_path), tmp_path, "cpu", size)


def test_an_earlier_demo_is_never_touched(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert new_folder(None).name == "demo"
    (tmp_path / "demo").mkdir()
    assert new_folder(None).name == "demo-2"
    (tmp_path / "demo" / "report.html").touch()
    with pytest.raises(FileExistsError, match="not empty"):
        new_folder(tmp_path / "demo")


def next_lines(output):
    """The commands below `Next:`, split as a shell would."""
    return [
        shlex.split(line, comments=True) for line in output.partition("Next:\n")[2].splitlines()
    ]


def test_the_next_commands_exist_and_name_the_photos_and_a_model(models, tmp_path):
    photos = noisy_photos(tmp_path / "my photos", 12, step=0.1)
    result = run_qgs("demo", photos, *models, "--scale", "0.5")
    assert result.exit_code == 0, result.output
    commands = next_lines(result.output)
    assert all(command[-2:] == ["--scale", "0.5"] for command in (commands[1], commands[0][:-4]))
    assert [command[1] for command in commands] == ["reconstruct", "view"]
    for _, name, *words in commands:
        assert words[0] in models
        assert words[1] == str(photos)
        options = run_qgs(name, "--help").output
        assert all(word in options for word in words if word.startswith("--"))
    page = (tmp_path / "demo" / "report.html").read_text()
    assert "my photos" in page.partition("Next:")[2].partition("</p>")[0]
    written = run_qgs(*commands[0][1:-1], "1")
    assert written.exit_code == 0, written.output
    assert (tmp_path / "demo" / "scene" / "refined").is_dir()


def test_the_page_has_the_remarks_and_warnings_that_were_printed(models, tmp_path, caplog):
    photos = noisy_photos(tmp_path / "mine", 12, step=0.1)
    shutil.copy(photos / "transforms.json", photos / "transforms_train.json")
    result = run_qgs("demo", photos, *models)
    page = html.unescape((tmp_path / "demo" / "report.html").read_text())
    notes = page.partition("<ul>")[2].partition("</ul>")[0]
    for remark in re.findall("<li>(.*)</li>", notes):
        assert remark in result.output + caplog.text
    assert "2 formats" in notes
    assert "few, more: the model sees" in notes
