"""`qgs demo` and `qgs report`: who is compared, on which photos, and what the page says."""

import html
import json
import re
import shlex
import shutil
from dataclasses import asdict
from pathlib import Path

import pytest
import yaml
from commands import done, record_of, saved
from photo_formats import noisy_photos, photo_set, write_nerfstudio
from qgs_viewer import report
from qgs_viewer.commands import new_folder
from qgs_viewer.compare import RECIPES
from qgs_viewer.comparison import open_models, resolve_fairly
from qgs_viewer.opening import open_source
from qgs_viewer.scenes import model_scenes
from small import RECIPE, stand_in
from tables import assert_near, must_refuse

import qgs
from qgs.drawing.images import rgb_picture
from qgs.recipe import resolve


@pytest.mark.slow
def test_recipes_are_trained_compared_and_reported(tmp_path):
    done(f"demo --seconds 1 --out {tmp_path} --train", *RECIPES)
    for name in ("tokengs", "locus"):
        for file in ("checkpoint.safetensors", "evaluation/summary.json"):
            assert (tmp_path / name / file).is_file()
    assert "type: locus/" in (tmp_path / "report.html").read_text()


def test_recipes_with_other_data_are_not_compared(tmp_path):
    few, more = (tmp_path / f"{name}.yaml" for name in ("few", "more"))
    few.write_text(yaml.safe_dump(RECIPE))
    more.write_text("{recipe: 1, extends: few.yaml, views: {gap: [2, 5]}}")
    assert [*resolve_fairly([few, few], seconds=1, seed=0)] == ["few", "few (2)"]
    must_refuse("more and few differ in views", resolve_fairly, [few, more], seconds=1, seed=0)


def test_all_systems_can_be_compared():
    """Though C3G trains on its input views and tuning would tune other things."""
    names = "tokengs locus ellipsoid gslrm c3g globalsplat tokengs_latent"
    files = [Path(f"tiny/{name}.yaml") for name in names.split()]
    assert resolve_fairly(files, seconds=1, seed=0)["c3g"].training.judge_inputs


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    return [stand_in(folder / f"{name}.safetensors") for name in ("few", "more")]


def opened(names, photos):
    return open_models(names, str(photos), "cpu")


def test_a_report_on_photos_says_what_was_printed_and_what_to_do_next(
    models, here, caplog, small_pictures
):
    photos = noisy_photos(here / "my photos", 12)
    shutil.copy(photos / "transforms.json", photos / "transforms_train.json")
    shown = done("report --scale 0.5 --photos", photos, *models).output
    page = html.unescape(Path("report/report.html").read_text())
    notes = page.partition("<ul>")[2].partition("</ul>")[0]
    for remark in re.findall("<li>(.*)</li>", notes):
        assert remark in shown + caplog.text
    assert "2 formats" in notes
    assert "few, more: the views lie outside" in notes
    assert "my photos" in page.partition("Next:")[2].partition("</p>")[0]

    lines = shown.partition("Next:\n")[2].splitlines()
    # as a shell would
    commands = [shlex.split(line, comments=True) for line in lines]
    assert [command[1] for command in commands] == ["reconstruct", "refine", "view"]
    reconstruct, refine, view = commands
    for _, name, model, place, *options in (reconstruct, view):
        assert model in models
        assert place == str(photos)
        assert options[:2] == ["--scale", "0.5"]
        known = done(f"{name} --help").output
        assert all(word in known for word in options if word.startswith("--"))
    assert refine[2:] == ["report/scene", str(photos)]
    done(*reconstruct[1:])
    record = record_of(Path("report/scene"))["to_photos"]
    assert record["scale"] == 0.5
    assert record["search"] is None


def test_no_model_is_marked_by_few_samples_or_below_a_baseline(models, tmp_path, monkeypatch):
    results = opened(models, noisy_photos(tmp_path, 12))
    assert results[0].evaluation.samples < report.RANKED
    columns = results[0].evaluation.columns
    assert not any(best for row in report.score_rows(results, columns).values() for _, best in row)
    monkeypatch.setattr(report, "RANKED", 1)
    rows = [row[0] for row in report.score_rows(results, columns).values()]
    highest = max(float(psnr) for psnr, _ in rows)
    assert [best for _, best in rows[:2]] == [float(psnr) == highest for psnr, _ in rows[:2]]


def test_small_scenes_keep_their_photos_and_others_every_eighth(models, tmp_path):
    noisy_photos(tmp_path / "large", 20)
    noisy_photos(tmp_path / "small", 3)
    noisy_photos(tmp_path / "tiny", 2)
    (result,) = opened(models[:1], tmp_path)
    compared = {
        score.scene: {frame for _, frames in score.views for frame in frames}
        for score in result.evaluation.scores
    }
    assert compared == {"large": {4, 12}, "small": {1}}
    assert [*result.evaluation.missing] == ["tiny"]


def test_a_comparison_has_more_windows_than_one_model(models, tmp_path):
    photos = noisy_photos(tmp_path / "mine", 48)
    for names, count in ((models, 6), (models[:1], 2)):
        first = opened(names, photos)[0]
        (scene,) = first.recipe.build_data().scenes("test")
        assert len(first.windows.windows(scene, first.recipe.views)) == count


def test_two_photos_are_compared_with_themselves(models, tmp_path, small_pictures):
    photos = noisy_photos(tmp_path / "two", 2)
    out = tmp_path / "demo"
    shown = done(f"demo {photos} --model {models[0]} --out {out}").output
    assert "No other photo shows how good new views are" in shown
    assert (out / "report.html").exists()


def test_a_model_tuned_on_the_photos_is_compared_on_those_it_never_saw(models, tmp_path):
    photos = str(noisy_photos(tmp_path / "mine", 20))
    tuned = saved(tmp_path / "tuned.safetensors", "qgs/photos", path=photos, holdout=5)
    results = opened([models[0], str(tuned)], photos)
    assert [result.recipe.views.scale for result in results] == ["search", "constant"]
    before, after = ([score.views for score in r.evaluation.scores] for r in results)
    assert before == after
    assert {frame for views in before for _, frames in views for frame in frames} <= {2, 7, 12, 17}
    shown = model_scenes(results, 2)
    ends = {float(own.samples[0].inputs.cameras.c2w[0, -1, :3, 3].norm()) for own in shown}
    assert len(ends) == 2


def test_an_earlier_demo_is_never_touched(here):
    assert new_folder(None, "demo").name == "demo"
    (here / "demo").mkdir()
    assert new_folder(None, "demo").name == "demo-2"
    (here / "demo/report.html").touch()
    must_refuse("not empty", new_folder, here / "demo", "demo", kind=FileExistsError)


RUN = "<script>alert(1)"


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """The page of `qgs demo` for RUN, which has a history and a card, and for another model."""
    folder = tmp_path_factory.mktemp("models")
    stand_in(folder / RUN / "checkpoint.safetensors")
    (folder / RUN / "checkpoint.md").write_text("Small, see https://example.org/small.")
    steps = [{"step": n, "seconds": n / 2, "loss": 1 / n, "psnr": 10.0 + n} for n in range(1, 9)]
    (folder / RUN / "history.jsonl").write_text("\n".join(map(json.dumps, steps)))
    more = stand_in(folder / "more.safetensors", queries=12)
    done(f"demo --model {folder}/{RUN} --model {more} --out {folder}/demo")
    return (folder / "demo/report.html").read_text()


def tags(page, name=r"\w+"):
    """The attributes of each start tag."""
    starts = re.findall(rf"<{name}\b([^>]*)>", page)
    return [dict(re.findall(r'([\w-]+)(?:="([^"]*)")?', start)) for start in starts]


def test_trained_models_are_shown_on_rooms_they_never_saw(page):
    text = html.unescape(page)
    assert "test/000001" in text
    assert f"{RUN}: 7000; more: 7000" in text
    assert "<h2>Training</h2>" in page


def test_names_cannot_break_the_page(page):
    assert "<script>alert" not in page
    assert page.count("<script>") == 1
    assert html.escape(RUN) in page


def test_the_page_needs_nothing_else(page):
    for found in tags(page):
        outward = found.keys() & {"src", "srcset", "data", "poster", "action"}
        assert all(found[name].startswith("data:") for name in outward)
    assert [link["href"] for link in tags(page, "a")] == ["https://example.org/small"]
    assert not tags(page, "link")
    pages = [found["data-page"] for found in tags(page, "button") if "data-page" in found]
    assert ["&lt;script" in page for page in pages] == [True, True]
    assert not any(re.search(r"(src|href)=.?http", page) for page in pages)


MODEL = "rooms/tokengs-64"
UNIT = 7.0


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """Photos of a room of the training's kind, UNIT times as large."""
    folder = tmp_path_factory.mktemp("room")
    recipe = resolve(qgs.load(MODEL).recipe, ["data.views_per_scene=12"])
    scene = recipe.build_data().scenes("test")[0]
    images = [*map(rgb_picture, scene.images(range(12)))]
    c2w = scene.cameras.c2w.double().numpy()
    c2w[:, :3, 3] *= UNIT
    lens = scene.cameras.intrinsics[0].tolist()
    return write_nerfstudio(folder / "photos", photo_set(folder, images, c2w, lens, "{:02d}.png"))


def test_a_room_in_another_unit_has_its_own_scale_in_all_commands(room, tmp_path, small_pictures):
    """With the same score too, of the one window that is judged."""
    (result,) = opened([MODEL], room)
    (score,) = result.evaluation.scores
    (_, inputs, compared), found = next(iter(result.scales.items()))
    done(f"reconstruct {MODEL} {room} --out {tmp_path}/out")
    record = record_of(tmp_path / "out")
    assert_near(record["to_photos"]["scale"], found.factor)
    assert record["to_photos"]["search"] == json.loads(json.dumps(asdict(found)))
    source = open_source(MODEL, photos=str(room))
    assert tuple(source.frames) == inputs
    assert_near(source.views.scale_factor, found.factor)
    quality = [view["psnr"] for view in record["views"] if view["kind"] == "novel"]
    assert abs(sum(quality) / len(quality) - score.values["model_psnr"]) <= 0.01
    trained = resolve(qgs.load(MODEL).recipe).views.scale_factor
    assert_near(found.factor, trained / UNIT, rtol=0.15)
    assert found.further
    # of three inputs, the middle one may be scored
    assert {*inputs[::2], *compared}.isdisjoint(found.further)
    assert found.psnr == max(psnr for _, psnr in found.tried)
    assert not found.poor


def test_a_scale_can_be_set(room, tmp_path):
    source = open_source(MODEL, photos=str(room), overrides=["views.scale=auto"])
    assert source.views.scale == "auto"
    for line in (
        f"demo {room} --model {MODEL} --out {tmp_path}/out",
        f"report {MODEL} --photos {room} --out {tmp_path}/out",
        f"view {MODEL} {room}",
    ):
        must_refuse("--scale", done, line, "--scale", "0")
