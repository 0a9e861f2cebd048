import re
import shutil

import pytest
from commands import run_qgs


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


def test_errors_have_exit_code_1_and_one_line_each(broken):
    result = run(broken, "--geometry", 0)
    assert result.exit_code == 1
    assert (
        "error: <b>bad, images/1.jpg: the image does not exist: add the file, or remove "
        "the frame from transforms.json\n" in result.output
    )
    assert "note: no pose was judged by photos (--geometry 0)" in result.output
    assert result.output.splitlines()[-1] == f"{broken}: 2 scenes, 1 error, 0 warnings"


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
