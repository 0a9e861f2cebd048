"""What stands in report.html, and its sections."""

import html
import json
import re

import pytest
from commands import done
from small import stand_in

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
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        done("demo", "--model", RUN, "--model", more)
    return (folder / "demo/report.html").read_text()


def tags(page, name=r"\w+"):
    """The attributes of each start tag."""
    starts = re.findall(rf"<{name}\b([^>]*)>", page)
    return [dict(re.findall(r'([\w-]+)(?:="([^"]*)")?', start)) for start in starts]


def test_trained_models_are_shown_on_rooms_they_never_saw(page):
    text = html.unescape(page)
    assert "test/000001" in text
    assert f"{RUN}: step 7000; more: step 7000" in text
    assert "<h2>Training</h2>" in page


def test_names_cannot_break_the_page(page):
    assert "<script>alert" not in page
    assert page.count("<script>") == 1
    assert html.escape(RUN) in page


def test_every_scene_can_be_chosen_and_is_there_without_choosing(page):
    radios = [found for found in tags(page, "input") if found["type"] == "radio"]
    assert len(radios) == len(tags(page, "article")) == 3
    assert [label["for"] for label in tags(page, "label")] == [radio["id"] for radio in radios]
    assert ["checked" in radio for radio in radios] == [True, False, False]


def test_pictures_are_in_the_page_and_have_words(page):
    alts = [picture["alt"] for picture in tags(page, "img") if "src" in picture]
    assert alts.count("") == 3  # thumbnails beside their names
    assert {f"{html.escape(RUN)}, error", "more, depth", "Truth, depth"} <= {*alts}
    sliders = [found["aria-label"] for found in tags(page, "input") if found["type"] == "range"]
    assert [html.escape(RUN) in label for label in sliders] == [True, False] * 3


def test_the_page_needs_nothing_else(page):
    for found in tags(page):
        outward = found.keys() & {"src", "srcset", "data", "poster", "action"}
        assert all(found[name].startswith("data:") for name in outward)
    assert [link["href"] for link in tags(page, "a")] == ["https://example.org/small"]
    assert not tags(page, "link")
    pages = [found["data-page"] for found in tags(page, "button") if "data-page" in found]
    assert ["&lt;script" in page for page in pages] == [True, True]
    assert not any(re.search(r"(src|href)=.?http", page) for page in pages)
