"""`qgs eval` as a user types it: indices, tuning, other weights, other settings, remarks."""

import csv
import shutil

import pytest
from commands import ONE_LAYER, done, run_qgs
from photo_formats import noise, noisy_photos, write_photos
from tables import contents, must_refuse, read_json, write_json
from training_runs import resume

import qgs
from qgs.cli.evaluate import evaluation_folder
from qgs.evaluate.tuning import tuning_settings
from qgs.recipe import resolve


def summary(folder):
    return read_json(folder / "summary.json")


@pytest.fixture
def run(trained, tmp_path):
    """A copy of the run."""
    return shutil.copytree(trained[1], tmp_path / "run")


def test_an_index_becomes_a_protocol_and_strict_evaluations_that_lack_a_scene_fail(
    trained, tmp_path
):
    index = tmp_path / "two: rooms.json"
    out = tmp_path / "out"
    entry = {"context": [0, 3], "target": [1, 2]}
    write_json(index, {"test/000001": entry, "absent": entry})
    words = (f"eval {trained[1]} --out {out} --index", index)
    done(*words)
    assert summary(out)["protocol"]["name"] == "two: rooms"
    assert read_json(out / "protocol.json")["views"]["index"].keys() == {"test/000001", "absent"}
    assert str(tmp_path) not in (out / "summary.json").read_text()
    assert run_qgs(*words, "--strict").exit_code == 1
    write_json(index, {"test/000001": entry})
    done(*words, "--strict")


def test_other_settings_go_into_a_folder_of_their_own_and_are_told(run):
    before = contents(run)
    done(f"eval {run} --tune 2 --set evaluation.scenes=1 --device cpu")
    told = summary(run / "evaluation-2")
    assert told["tuning"]["steps"] == 2
    assert told["scenes"] == 1
    assert told["step"] == 2
    assert before.items() <= contents(run).items()


PLUGIN = """
from qgs.contracts import Column, Metric, Plugin
class Mean(Metric):
    name = "mean"
    definition, column = "mean colour", Column("level", "higher")
    def forward(self, given):
        return given.images.mean((-3, -2, -1))
plugin = Plugin("mine", 1, (Mean,))
"""


def test_a_metric_of_a_plugin_that_was_installed_later(run, tmp_path, install):
    install("mine", "mine", PLUGIN)
    out = tmp_path / "out"
    more = ("plugins=[mine]", "metrics.level.type=mine/mean")
    done(" --set ".join((f"eval {run}/checkpoint.safetensors --out {out}", *more)))
    assert "level" in summary(out)["columns"]
    judged = resolve(resolve(run / "recipe.yaml").tree, ("training.steps=3", *more))
    result = resume(judged, run)
    assert result.resumed_at == 2
    assert "mine" in result.model.recipe["plugins"]


def test_other_weights_of_a_run_keep_its_evaluation(tmp_path):
    (tmp_path / "evaluation_ema-2").mkdir()
    names = ("checkpoint", "published", "checkpoint_ema")
    files = [tmp_path / f"{name}.safetensors" for name in names]
    usual, other = ([evaluation_folder(f, x).name for f in files] for x in (False, True))
    assert usual == ["evaluation", "evaluation_published", "evaluation_ema"]
    assert other == ["evaluation-2", "evaluation_published-2", "evaluation_ema-3"]


def test_settings_of_the_trained_model_are_refused(trained):
    for setting in ("training.steps=1", "model.feedback.rounds_more=1"):
        must_refuse("would change the trained model", done, f"eval {trained[1]} --set {setting}")


def test_tune_says_what_and_how_often():
    assert tuning_settings("0") == ["evaluation.tuning_steps=0"]
    for tune, what, steps in (("latents", "latents", 50), ("queries:20", "queries", 20)):
        settings = [f"evaluation.tuning_steps={steps}", f"evaluation.tuning={what}"]
        assert tuning_settings(tune) == settings


def test_an_evaluation_names_its_photos_and_says_where_a_copy_is_better(tmp_path):
    """Of photos alike but for a little noise, and Gaussians as large as they can be."""
    write_photos(noisy_photos(tmp_path, 9) / "images", 90 + noise(9, 20, 24, 3) % 9)
    data = f"data={{type: qgs/photos, path: {tmp_path}, image_size: [16, 16], holdout: 3}}"
    views = "views={inputs: 2, targets: 2, gap: [2, 4], scale: constant}"
    model = qgs.compose(ONE_LAYER, [data, views])
    model.head.linear.bias.data.unflatten(0, (-1, 14))[:, 6:9] = 5.0
    domain = '{"samples": 4, "ranges": {"baseline": [0, 9]}}'
    qgs.save(model, tmp_path / "checkpoint.safetensors", extra={"trained_on": domain})
    done(f"eval {tmp_path}")
    folder = tmp_path / "evaluation"
    remarks = summary(folder)["remarks"]
    for word in ("worse than a copy of the nearest", "within"):
        assert sum(word in remark for remark in remarks) == 1, word
    (row,) = csv.DictReader((folder / "scenes.csv").open())
    firsts = [row[name].split("; ")[0] for name in ("input_frames", "target_frames")]
    assert firsts == ["images/0.png images/6.png", "images/1.png images/4.png"]
