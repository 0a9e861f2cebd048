import re
import shutil

import pytest
import torch
from commands import run_qgs
from qgs_datatools.check import CheckReport, SceneReport

from qgs.geometry.poses import look_at


@pytest.fixture(scope="module")
def sound(good):
    return good / "room"


@pytest.fixture(scope="module")
def broken(sound, tmp_path_factory):
    """A folder of folders: a sound room, and one with a missing image and markup in its name."""
    path = tmp_path_factory.mktemp("many")
    shutil.copytree(sound, path / "sound")
    shutil.copytree(sound, path / "<b>bad")
    (path / "<b>bad" / "images" / "1.jpg").unlink()
    return path


def run(*arguments):
    return run_qgs("data", "check", *arguments)


def test_a_sound_set_has_exit_code_0_and_a_table(sound):
    result = run(sound)
    assert result.exit_code == 0, result.output
    lines = result.output.splitlines()
    assert re.fullmatch(
        r"scene +format +frames +decodable +missing +bad poses +epipolar px", lines[0].strip()
    )
    assert re.fullmatch(r"room +nerfstudio +6 +6 +0 +0 +0\.\d\d", lines[1].strip())
    assert lines[-2] == (
        "note: views.scale: auto finds no common point that the cameras look at in room"
    )
    assert lines[-1] == f"{sound}: 1 scene, 0 errors, 0 warnings"


def around(name, radius):
    """A scene of cameras that look at the origin from a circle."""
    angles = torch.linspace(0, 2, 7)
    eyes = radius * torch.stack([angles.sin(), 0 * angles, -angles.cos()], -1)
    c2w = look_at(eyes, -eyes, torch.tensor([0.0, 1, 0]).expand(7, 3))
    return SceneReport(name, name, "colmap", c2w=c2w[:, :3].numpy())


@pytest.mark.parametrize(
    ("scenes", "said"),
    [
        ([around("a", 4)], "is a factor of 0.25"),
        ([around("a", 4), around("b", 2)], "is a factor of 0.375, from 0.25 to 0.5"),
        (
            [around("a", 4), SceneReport("walk", "walk", "colmap")],
            "is a factor of 0.25 and finds no common point that the cameras look at in walk",
        ),
    ],
)
def test_the_factor_of_an_automatic_scale_is_told(scenes, said):
    assert CheckReport("", scenes, [], [], 0, []).auto_scale == f"views.scale: auto {said}"


def test_errors_have_exit_code_1_and_one_line_each(broken):
    result = run(broken, "--geometry", 0)
    assert result.exit_code == 1
    assert (
        "error: <b>bad, images/1.jpg: the image does not exist: add the file, or remove "
        "the frame from transforms.json\n" in result.output
    )
    assert "note: no pose was judged by photos (--geometry 0)" in result.output
    assert result.output.splitlines()[-1] == f"{broken}: 2 scenes, 1 error, 0 warnings"


def test_a_path_that_is_no_data_set_is_a_mistake(tmp_path):
    result = run(tmp_path / "nowhere")
    assert isinstance(result.exception, FileNotFoundError)
    (tmp_path / "empty").mkdir()
    assert "holds nothing" in str(run(tmp_path / "empty").exception)


def test_the_page_needs_no_other_file(broken, tmp_path):
    page = tmp_path / "new" / "check.html"
    result = run(broken, "--report", page, "--geometry", 1)
    assert result.exit_code == 1
    html = page.read_text()
    assert [file.name for file in page.parent.iterdir()] == ["check.html"]
    assert not re.search(r'(src|href)="(?!data:)', html)
    assert "&lt;b&gt;bad" in html
    assert "<b>bad" not in html
    assert "the image does not exist" in html
    assert html.count('alt="cameras of') == 2
    assert html.count('alt="worst pair of') == 1


def test_quick_reads_headers_only(room):
    file = room.path / "images" / "2.jpg"
    file.write_bytes(file.read_bytes()[:-400])
    result = run(room.path, "--quick")
    assert result.exit_code == 0, result.output
    assert "quick: only headers of images were read" in result.output
    assert run(room.path, "--geometry", 0).exit_code == 1
