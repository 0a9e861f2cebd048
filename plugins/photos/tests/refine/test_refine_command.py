"""`qgs refine` on what `qgs reconstruct` wrote: photos that are used, files, what is refused."""

import shutil

import pytest
from commands import done, record_of, saved
from photo_formats import noisy_photos
from plyfile import PlyData
from reconstructing import HOLDOUTS, kinds
from tables import must_refuse, write_json

pytestmark = pytest.mark.usefixtures("small_pictures")


@pytest.fixture
def reconstruction(checkpoint, photos, tmp_path):
    done("reconstruct", checkpoint, photos, "--scale", 0.5, "--out", tmp_path / "made")
    return tmp_path / "made"


def refined_in(file):
    """How many Gaussians lie within the surroundings, which are the largest, of one size."""
    sizes = PlyData.read(file)["vertex"]["scale_0"]
    return (sizes < sizes.max()).sum()


def test_photos_held_out_are_compared_with_and_not_refined_on(checkpoint, photos, tmp_path):
    for options, compared in HOLDOUTS.items():
        out = tmp_path / f"out{options}"
        words = (*options.split(), "--scale", 0.5, "--out", out)
        done("reconstruct", checkpoint, photos, *words)
        done("refine", out, photos, "--seconds", 0.01)
        record = record_of(out / "refined")
        assert record["refinement"]["frames"] == [*{*range(7)} - compared], options
        assert kinds(record) == kinds(record_of(out))


def test_photos_of_the_training_are_not_called_novel_and_those_held_out_never_refined_on(
    photos, tmp_path
):
    """Of which 1 and 4 were held out."""
    file = saved(tmp_path / "own.safetensors", "qgs/photos", path=str(photos), holdout=3)
    made = tmp_path / "made"
    done("reconstruct", file, photos, "--frames", "0,6", "--holdout", "1,3", "--out", made)
    larger = ("--gaussians", 50, "--size", "20x24")
    for name, words, frames, size, count in (
        ("inputs", ["--inputs-only"], [0, 6], [16, 16], 32),
        ("all", larger, [0, 2, 5, 6], [20, 24], 50),
    ):
        out = tmp_path / name
        done("refine", made, photos, "--seconds", 0.05, *words, "--out", out)
        record = record_of(out)
        assert kinds(record) == kinds(record_of(made))
        assert record["refinement"]["frames"] == frames
        assert record["views"][0]["size"] == size
        assert refined_in(out / "gaussians.ply") == count
    assert PlyData.read(made / "gaussians.ply")["vertex"].count == 32


def test_an_earlier_result_stays_and_a_single_file_is_written(reconstruction, photos, tmp_path):
    file = tmp_path / "refined.ply"
    words = ("refine", reconstruction, photos, "--seconds", 0.01, "--out", file)
    done(*words)
    assert refined_in(file) == 32
    must_refuse("refined.ply", done, *words, kind=FileExistsError)


def test_what_makes_no_sense_is_refused_in_a_sentence(reconstruction, photos, tmp_path):
    moved = noisy_photos(tmp_path / "moved", step=0.15)
    by_hand = shutil.copytree(reconstruction, tmp_path / "by hand")
    damaged = shutil.copytree(reconstruction, tmp_path / "damaged")
    write_json(by_hand / "cameras.json", {**record_of(by_hand), "model": ""})
    (damaged / "cameras.json").write_text("{}")
    out = tmp_path / "out"
    for source, given, options, message in (
        (tmp_path / "none", photos, (), "give a folder that `qgs reconstruct` wrote"),
        (by_hand, photos, (), "a model that is not in a file"),
        (damaged, photos, (), "does not describe a reconstruction"),
        (reconstruction, moved, ("--scene", "moved"), "or their poses have changed"),
        (reconstruction, photos, ("--seconds", 0), "--seconds must be a finite time above 0"),
    ):
        words = ("refine", source, given, *options, "--out", out)
        must_refuse(message, done, *words, kind=(ValueError, OSError))
        assert not out.exists()
