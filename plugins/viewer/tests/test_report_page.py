"""report.html in a real browser: chooser, sliders, zoom, dark, and the scene in its frame."""

import io
import re
from importlib.metadata import entry_points
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("viser", reason="viser is not installed: pip install query-gaussians-viewer")

from browser import CHROMIUM, Page, chromium
from qgs_viewer import section
from qgs_viewer.look import look_inside
from qgs_viewer.page import shared_start
from qgs_viewer.section import refinement_section, scene_section, self_attention_section
from small import VIEWS, Walk, model_of

from qgs.analysis.report import GROUP, Contender, Report, report_html
from qgs.contracts import Column
from qgs.data.sampling import Sample, make_sample
from qgs.drawing.queries import notable_queries

KINDS = ("tokengs", "locus")
SHOWN = "[...document.querySelectorAll('article')].map(a => a.checkVisibility())"


def sample_of(*targets: int) -> Sample:
    return make_sample(Walk(), (0, 5), targets, VIEWS, mirror=False)


def contenders() -> list[Contender]:
    return [Contender(kind, model_of(kind), {"psnr": 9.0}, 96, 1000, "recipe: 1") for kind in KINDS]


def page_of_two_scenes() -> str:
    report = Report(
        columns={"psnr": Column("PSNR", "higher", 2, "dB")},
        title="A title",
        contenders=contenders(),
        baselines={},
        samples=[sample_of(1, 2), sample_of(3, 4)],
        depths=[None, None],
        facts={},
    )
    return report_html(report)


def test_the_viewer_offers_its_sections() -> None:
    found = {e.name: e.load() for e in entry_points(group=GROUP) if e.module.startswith("qgs_view")}
    assert found == {
        "refinement": refinement_section,
        "scene": scene_section,
        "self_attention": self_attention_section,
    }


def test_refinement_is_shown_of_models_with_anchors() -> None:
    sample = sample_of(1, 2)
    shown = [(one, one.model(sample.inputs)) for one in contenders()]
    (tile,) = refinement_section(shown, sample).figures[""]
    (single,) = refinement_section(shown[1:], sample).figures[""]
    np.testing.assert_array_equal(tile.image, single.image)
    assert not refinement_section(shown[:1], sample).figures


def test_self_attention_is_shown_of_models_that_tell_it() -> None:
    sample = sample_of(1, 2)
    shown = [(one, one.model(sample.inputs)) for one in contenders()]
    (tile,) = self_attention_section(shown, sample).figures[""]
    (single,) = self_attention_section(shown[:1], sample).figures[""]
    assert np.asarray(tile.image).shape[1] > 1.5 * np.asarray(single.image).shape[1]
    silent = contenders()[:1]
    for layer in silent[0].model.decoder:
        layer.self_attention.explain = lambda *parts: None
    try:
        assert not self_attention_section([(silent[0], shown[0][1])], sample).figures
    finally:
        for layer in silent[0].model.decoder:
            del layer.self_attention.explain


def test_the_section_has_all_models_and_the_code_of_the_viewer_once() -> None:
    sample = sample_of(1, 2)
    shown = [(one, one.model(sample.inputs)) for one in contenders()]
    (tile,) = scene_section(shown, sample).figures[""]
    one = scene_section(shown[:1], sample).figures[""][0]
    assert tile.caption == "tokengs, locus"
    assert np.asarray(tile.image).shape == (240, 2 * 320 + 4, 3)
    assert len(tile.page) - len(one.page) < 100_000 < len(one.page)
    assert tile.page.index('["tokengs"') < tile.page.index('["locus"')
    assert not re.search(r"(src|href)=.?http", tile.page)


def test_a_notable_query_of_a_model_with_anchors_is_picked(monkeypatch: pytest.MonkeyPatch) -> None:
    sample, chosen = sample_of(1, 2), {}
    monkeypatch.setattr(section, "scenes_html", lambda _, choices: chosen.update(choices) or "")
    shown = [(one, one.model(sample.inputs)) for one in contenders()]
    scene_section(shown, sample)
    (locus, prediction) = shown[1]
    looks = [look_inside(one.model, sample.inputs) for one, _ in shown]
    view = section._first_camera(shared_start(looks))
    (notable,) = notable_queries(locus.model, prediction.gaussians, view, 1)
    assert [*chosen] == ["locus"]
    assert (chosen["locus"].query, chosen["locus"].layer) == (notable.index, locus.model.depth)
    assert chosen["locus"].others == "shown"


def drawn(page: Page, folder: Path, name: str) -> np.ndarray:
    shot = page.screenshot(folder / f"{name}.png")
    return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB")).astype(int)


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium: apt install chromium")
def test_the_page_in_a_browser(tmp_path: Path) -> None:
    file = tmp_path / "report.html"
    file.write_text(page_of_two_scenes(), encoding="utf-8")
    with chromium(tmp_path / "profile") as page:
        page.follow_frames()
        page.open(file.as_uri())
        page.until("the script", "document.readyState == 'complete' && !!window.theme.textContent")
        _choose(page)
        _slide(page, tmp_path)
        _zoom(page)
        _darken(page)
        _print(page)
        _turn(page, tmp_path)
        assert page.targets.count("worker") == 2, "each scene sorts its Gaussians in a worker"
        assert page.errors == []
        assert {urlsplit(r).scheme for r in page.requests} <= {"file", "data", "blob"}
        assert [r for r in page.requests if r.startswith("file:")] == [file.as_uri()]


def _choose(page: Page) -> None:
    assert page.evaluate(SHOWN) == [True, False]
    page.evaluate("document.querySelectorAll('.scenes > label')[1].click()")
    assert page.evaluate(SHOWN) == [False, True]
    page.evaluate("document.querySelector('.scenes > input:checked').focus()")
    page.key("ArrowLeft", 37)
    assert page.evaluate(SHOWN) == [True, False]


def _slide(page: Page, folder: Path) -> None:
    page.evaluate("document.querySelector('.compare').scrollIntoView()")
    place = "document.querySelector('.compare > div').getBoundingClientRect()"
    left, top, width = (page.evaluate(f"{place}.{side}") for side in ("left", "top", "width"))
    window = slice(int(top) + 4, int(top) + 200), slice(int(left) + 4, int(left + width) - 4)
    page.click(left + width - 3, top + 50)
    truth = drawn(page, folder, "truth")[window]
    page.click(left + 3, top + 50)
    render = drawn(page, folder, "render")[window]
    assert page.evaluate("+document.querySelector('.compare input').value") < 5
    for _ in range(3):
        page.key("PageUp", 33)
    value = page.evaluate("+document.querySelector('.compare input').value")
    assert 20 < value < 60
    mixed, cut = drawn(page, folder, "mixed")[window], int(truth.shape[1] * value / 100)
    assert np.abs(truth - render).mean() > 10
    np.testing.assert_allclose(mixed[:, : cut - 8], truth[:, : cut - 8], atol=3)
    np.testing.assert_allclose(mixed[:, cut + 8 :], render[:, cut + 8 :], atol=3)


def _zoom(page: Page) -> None:
    opened = "document.getElementById('zoom').open"
    alt = "document.querySelector('#zoom img').alt"
    page.evaluate("document.querySelector('.kinds img').focus()")
    page.key("Enter", 13)
    assert page.evaluate(opened)
    assert page.evaluate(alt).startswith("Truth, render")
    page.key("ArrowRight", 39)
    assert page.evaluate(alt).startswith("tokengs, render")
    assert page.evaluate("document.querySelector('#zoom img').clientHeight") > 400
    page.key("Escape", 27)
    assert not page.evaluate(opened)
    back = "document.activeElement.alt?.startsWith('tokengs, render')"
    page.until("the focus on the picture that was seen last", back, 10)
    page.evaluate("document.querySelector('.inputs img').click()")
    assert page.evaluate(opened)
    page.evaluate("document.getElementById('zoom').click()")
    assert not page.evaluate(opened)


def _darken(page: Page) -> None:
    paper = "getComputedStyle(document.body).backgroundColor"
    assert page.evaluate(paper) == "rgb(255, 255, 255)"
    page.evaluate("document.getElementById('theme').click()")
    dark = page.evaluate(paper)
    assert dark != "rgb(255, 255, 255)"
    assert page.evaluate("document.getElementById('theme').textContent") == "Light"
    page.evaluate("document.getElementById('theme').click()")
    system = [{"name": "prefers-color-scheme", "value": "dark"}]
    page.call("Emulation.setEmulatedMedia", features=system)
    assert page.evaluate(paper) == "rgb(255, 255, 255)", "the button wins"
    page.evaluate("document.documentElement.style.colorScheme = ''")
    assert page.evaluate(paper) == dark


def _print(page: Page) -> None:
    page.call("Emulation.setEmulatedMedia", media="print")
    assert page.evaluate(SHOWN) == [True, True]
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    for what in ("#theme", ".scenes > label", ".compare input", ".open span"):
        assert not page.evaluate(f"document.querySelector('{what}').checkVisibility()"), what
    pair = "[...document.querySelectorAll('.compare:first-child img')].slice(0, 2)"
    tops, lefts = (
        page.evaluate(f"{pair}.map(i => i.getBoundingClientRect().{side})")
        for side in ("top", "left")
    )
    assert tops[0] == tops[1]
    assert lefts[0] < lefts[1]
    page.call("Emulation.setEmulatedMedia", media="", features=[])


def _turn(page: Page, folder: Path) -> None:
    assert not page.evaluate("!!document.querySelector('iframe')")
    page.evaluate("document.querySelector('.open').scrollIntoView()")
    page.evaluate("document.querySelector('.open').click()")
    place = "document.querySelector('iframe').getBoundingClientRect()"
    left, top, width = (int(page.evaluate(f"{place}.{s}")) for s in ("left", "top", "width"))
    half, rows = width // 2, slice(top + 160, top + 400)

    def both_drawn() -> bool:
        shot = drawn(page, folder, "scene")[rows]
        first, second = shot[:, left : left + half], shot[:, left + half : left + width]
        return bool(first.std() > 8 and second.std() > 8)

    page.until("both scenes", both_drawn, 180)
