"""`qgs data check` as a user sees it."""

import re
import shutil

from commands import run_qgs


def run(words):
    result = run_qgs("data", "check", *words.split())
    return result.output, result.exit_code


def test_a_sound_set_has_exit_code_0_and_a_table(good):
    output, code = run(f"{good}/room")
    assert code == 0, output
    header, row, *_, note, last = map(str.strip, output.splitlines())
    columns = "scene  format  frames  decodable  missing  bad poses  epipolar px"
    assert re.sub("  +", "  ", header) == columns
    assert re.fullmatch(r"room +nerfstudio +6 +6 +0 +0 +0\.\d\d", row)
    assert note == "note: views.scale: auto finds no common point that the cameras look at in room"
    assert last == f"{good}/room: 1 scene, 0 errors, 0 warnings"


def test_errors_have_exit_code_1_and_a_line_each_and_a_page_without_other_files(
    room, tmp_path, monkeypatch
):
    """Of a sound room, and of one with a missing image and markup in its name."""
    monkeypatch.setattr("qgs_photos.datatools.page._DPI", 20)
    (shutil.copytree(room, tmp_path / "<b>bad") / "images/1.jpg").unlink()
    page = tmp_path / "new/check.html"
    output, code = run(f"{tmp_path} --report {page} --geometry 1")
    assert code == 1
    fix = "add the file, or remove the frame from transforms.json"
    assert f"error: <b>bad, images/1.jpg: the image does not exist: {fix}\n" in output
    assert f"{tmp_path}: 2 scenes, 1 error, 0 warnings\n" in output
    html = page.read_text()
    assert [*page.parent.iterdir()] == [page]
    assert not re.search(r'(src|href)="(?!data:)', html)
    assert "&lt;b&gt;bad" in html
    assert "<b>bad" not in html
    assert "the image does not exist" in html
    assert html.count('alt="cameras of') == 2
    assert html.count('alt="worst pair of') == 1


def test_quick_reads_headers_only(room):
    file = room / "images/2.jpg"
    file.write_bytes(file.read_bytes()[:-400])
    output, code = run(f"{room} --quick")
    assert code == 0, output
    assert "quick: only headers of images were read" in output
    output, code = run(f"{room} --geometry 0")
    assert code == 1
    assert "note: no pose was judged by photos (--geometry 0)" in output
