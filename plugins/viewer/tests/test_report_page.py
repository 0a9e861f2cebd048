"""report.html in a real browser: chooser, sliders, zoom, dark, and the scene in its frame."""

import io
import re
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from browser import CHROMIUM, Page, chromium
from PIL import Image
from qgs_viewer.figures.exhibits import Exhibit, exhibit
from qgs_viewer.report import Contender, Report, report_html
from qgs_viewer.section import (
    scene_section,
)
from small import VIEWS, Walk, model_of

from qgs.contracts import Column
from qgs.data.samples import Sample, make_sample

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
        facts={},
    )
    return report_html(report)


def exhibits() -> list[Exhibit]:
    return [exhibit(one.name, one.model, sample_of(1, 2)) for one in contenders()]


def test_the_section_has_all_models_and_the_code_of_the_viewer_once() -> None:
    both = exhibits()
    (tile,) = scene_section(both).figures[""]
    one = scene_section(both[:1]).figures[""][0]
    assert tile.caption == "tokengs, locus"
    assert np.asarray(tile.image).shape == (240, 2 * 320 + 4, 3)
    assert len(tile.page) - len(one.page) < 100_000 < len(one.page)
    assert tile.page.index('["tokengs"') < tile.page.index('["locus"')
    assert not re.search(r"(src|href)=.?http", tile.page)


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
        _name_at_length(page)
        _slide(page, tmp_path)
        _zoom(page)
        _darken(page)
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


def _name_at_length(page: Page) -> None:
    """File names of 60 characters without a space push no photo out of its column."""
    captions = "document.querySelectorAll('.scene figcaption')"
    page.evaluate(f"{captions}.forEach(caption => caption.textContent = 'x'.repeat(60))")
    side = "document.querySelector('.scene').querySelector('{}').getBoundingClientRect().{}"
    assert page.evaluate(side.format(".inputs figure", "right")) <= page.evaluate(
        side.format(".kinds", "left")
    )
    widths = (
        "[...document.querySelectorAll('.scene .rows figure')].filter(f => f.checkVisibility())"
    )
    assert page.evaluate(f"{widths}.every(f => f.scrollWidth <= f.clientWidth + 1)")


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
