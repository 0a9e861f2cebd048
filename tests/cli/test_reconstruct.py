"""`qgs reconstruct` as a user types it: files, photos that are used, what is refused."""

from pathlib import Path

import numpy as np
import tape_source
import torch
from commands import done, record_of, saved
from numpy.testing import assert_allclose
from photo_formats import put, scene
from PIL import Image
from reconstructing import HOLDOUTS, kinds
from tables import assert_near, must_refuse, names_in, rows

import qgs
from qgs.reconstruction.scenes import frame_list


def written(out, line, *words):
    """The record of a run into `out`."""
    done(f"reconstruct --out {out} {line}", *words)
    return record_of(Path(out))


def test_everything_is_written_and_what_a_user_made_is_kept(checkpoint, photos, here):
    notes = here / "notes.ply"
    old = here / "views/00099_novel.png"
    notes.write_text("mine")
    put(old, b"")
    for out, flags, word in (
        (notes, "", "notes"),
        (".", "", "--overwrite"),
        (".", "--overwrite", "views"),
    ):
        must_refuse(word, written, out, f"{checkpoint} {photos} {flags}", kind=FileExistsError)
        assert {*here.rglob("*")} == {notes, old.parent, old}
    Path("gaussians.ply").touch()  # as an earlier result has it
    record = written(".", f"{checkpoint} {photos} --overwrite --set views.scale=auto")
    assert notes.read_text() == "mine"
    assert not old.exists()
    assert qgs.load_ply("gaussians.ply").count == 32
    assert kinds(record) == {2: "input", 4: "input", 3: "novel"}
    chosen = "inputs images/2.png, images/4.png, compared with images/3.png; 1 of 7 photos held out"
    assert record["remarks"][-1].startswith(chosen)
    back = record["to_photos"]
    assert_near(back["scale"], 1 / 0.6)
    assert_allclose(record["views"][0]["c2w"], np.eye(4), atol=1e-6)
    for view in record["views"]:
        centre = np.array(view["c2w"])[:3, 3] / back["scale"]
        world = back["reference_c2w"] @ np.array([*centre, 1])
        assert_allclose(world, [0.1 * view["frame"], 0, 0, 1], atol=1e-6)
    assert Image.open("views/00003_novel.png").size == (36, 16)
    assert Image.open("depth/00004_input.png").size == (16, 16)
    assert Image.open("overview.png").size[0] > 500
    assert Image.open("orbit.gif").n_frames == len(record["orbit"])


def test_photos_held_out_are_compared_with(checkpoint, photos, here, small_pictures):
    for options, compared in (HOLDOUTS | {"--frames 2,4": {3}}).items():
        record = written(here, f"{checkpoint} {photos} {options} --overwrite")
        assert {f for f, kind in kinds(record).items() if kind == "novel"} == compared, options


def test_a_call_gives_what_the_command_gives(checkpoint, photos, here, small_pictures):
    line = f"{checkpoint} {photos} --frames 0.png,images/4.png --set views.scale=auto --holdout"
    record = written("command", line, "1, 3.png")
    assert [view["photo"] for view in record["views"]] == [f"images/{i}.png" for i in (0, 4, 1, 3)]
    chosen = {"frames": [0, "4.png"], "compare": [1, "3.png"], "overrides": ["views.scale=auto"]}
    result = qgs.reconstruct(qgs.load(checkpoint), photos, **chosen)
    for file in result.save("call"):
        assert file.is_dir() or file.read_bytes() == Path("command", file.name).read_bytes(), file
    own = qgs.load_ply("call/gaussians.ply")
    torch.testing.assert_close(own.means, result.gaussians.means)  # in the model's world


def test_photos_of_the_training_are_not_called_novel(photos, here, small_pictures):
    """Of which 1 and 4 were held out."""
    file = saved("own.safetensors", "qgs/photos", path=str(photos), holdout=3)
    record = written("default", f"{file} {photos} --set views.scale_factor=0.5")
    assert kinds(record) == {0: "input", 2: "input", 1: "novel"}
    assert record["to_photos"]["scale"] == 0.5
    record = written("named", f"{file} {photos} --frames 0,6 --holdout 1,3")
    assert kinds(record) == {0: "input", 6: "input", 1: "novel", 3: "seen in training"}


def test_the_data_of_a_plugin(checkpoint, here, install, small_pictures):
    install(*tape_source.INSTALLED)
    for name in "ab":
        tape_source.write_tape(here / f"tapes/{name}.tape")
    record = written("out", f"{checkpoint} tapes --scene b --frames 0,5 --holdout 1,2")
    assert record["scene"] == "b"
    assert kinds(record) == {0: "input", 5: "input", 1: "novel", 2: "novel"}


def test_tuned_tokens_meet_the_inputs_better_and_are_told(checkpoint, photos, here, small_pictures):
    # noise has no scale, and at some nothing is seen
    tuning = written("out", f"{checkpoint} {photos} --tune 3 --scale 0.15")["tuning"]
    assert tuning["steps"] == 3
    assert tuning["loss_after"] < tuning["loss_before"]
    plain = qgs.reconstruct(qgs.load(checkpoint), photos, overrides=["views.scale_factor=0.15"])
    assert plain.tuning is None
    assert not torch.allclose(qgs.load_ply("out/gaussians.ply").means, plain.gaussians.means)


def test_photos_that_are_not_there_are_refused(photos):
    found = scene(photos)
    assert frame_list("0,8", "--frames", found) == [0, 8]
    must_refuse(r"--frames: '0-8' is no photo", frame_list, "0-8", "--frames", found)
    found.frame_name = ["a/1.png", "b/1.png", "11.png", *"defg"].__getitem__
    assert frame_list("b/1.png", "--frames", found) == [1]
    reason = r"'1\.png' matches 0 \(a/1\.png\), 1 \(b/1\.png\)\."
    must_refuse(reason, frame_list, "1.png", "--frames", found)


SENSELESS = """
--size 64 | --size
--scale 0 | --scale
--set views.scale=big | views.scale
--set data.path=x | data.path
"""


def test_options_that_make_no_sense_are_refused(checkpoint, photos, here):
    for words, reason in rows(SENSELESS):
        must_refuse(reason, written, "out", f"{checkpoint} {photos} {words}")
    assert not names_in(here)
