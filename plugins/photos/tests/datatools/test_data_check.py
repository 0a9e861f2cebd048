"""`qgs data check` as a user sees it."""

import re
import shutil

from commands import run_qgs
from photo_formats import cut


def run(words):
    result = run_qgs(f"data check {words}")
    return result.output, result.exit_code


def test_a_sound_set_has_exit_code_0_and_a_table(good):
    output, code = run(f"{good}/room")
    assert code == 0, output
    header, row, note, last = map(str.strip, output.splitlines())
    columns = "scene  format  frames  decodable  missing  bad poses  epipolar px"
    assert re.sub("  +", "  ", header) == columns
    assert re.fullmatch(r"room +nerfstudio +6 +6 +0 +0 +0\.\d\d", row)
    assert note == "note: `views.scale: auto` finds no common point that the cameras look at"
    assert last == f"{good}/room: 1 scene, 0 errors, 0 warnings"


def test_errors_have_exit_code_1_and_a_line_each(room, tmp_path):
    (shutil.copytree(room, tmp_path / "bad") / "images/1.jpg").unlink()
    output, code = run(f"{tmp_path} --geometry 1")
    assert code == 1
    line = "error: bad, images/1.jpg: the image does not exist: add it, or remove its frame\n"
    assert line in output
    assert "note: poses were checked by photos in 1 of 2 scenes" in output
    assert output.endswith(f"{tmp_path}: 2 scenes, 1 error, 0 warnings\n")


def test_quick_reads_headers_only(room):
    cut(room / "images/2.jpg", 0.9)
    assert run(f"{room} --quick")[1] == 0
    assert run(f"{room} --geometry 0")[1] == 1
