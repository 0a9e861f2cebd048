"""The viewer and its pages in a real browser: they draw, follow what is done, ask for nothing."""

import time
from dataclasses import replace
from urllib.parse import urlsplit

import numpy as np
import pytest
import torch
from browser import CHROMIUM, chromium
from PIL import Image
from qgs_viewer.comparison import open_models
from qgs_viewer.opening import open_source
from qgs_viewer.page import Tour, gaussians_html, quiet_server, scene_html
from qgs_viewer.panel import Panel
from qgs_viewer.query_scene import QueryScene
from qgs_viewer.report import Comparison, report_html
from qgs_viewer.scenes import model_scenes
from small import PAIR, stand_in
from torch.nn.functional import normalize
from walk import arc, cloud, pinhole

from qgs.drawing.images import rgb_picture
from qgs.geometry.harmonics import harmonics
from qgs.renderers import AutoRenderer
from qgs.types import Views

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium: apt install chromium"),
]
MODEL = "rooms/locus-64"
SCENE = (slice(160, 640), slice(330, 930))  # of the window: no panel, no notice


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    with chromium(tmp_path_factory.mktemp("profile")) as page:
        yield page


def drawn(page, unlike=None):
    """The scene once it stands still, has colours, and is another than before."""
    page.until("the canvas", "!!document.querySelector('canvas')")
    pictures = [page.picture()[SCENE]]

    def stands():
        time.sleep(1)
        pictures.append(page.picture()[SCENE])
        last, now = pictures[-2:]
        differs = unlike is None or (abs(now - unlike).max(-1) > 24).mean() > 0.005
        return now.std() > 4 and differs and abs(now - last).max(-1).mean() < 0.5

    page.until("a picture", stands)
    return pictures[-1]


def test_the_viewer(page):
    source = open_source(MODEL)
    source.title = "<b id=named>*name*</b> 1. [x](y)"
    with quiet_server() as server:
        panel = Panel(server, source)
        address = f"127.0.0.1:{server.get_port()}"
        page.open(f"http://{address}")
        opened = drawn(page)
        page.until("its name", f"document.body.innerText.includes({source.title!r})")
        assert page.evaluate("document.querySelector('#named')") is None

        def picks():
            page.drag(*next(places))
            time.sleep(2)
            page.evaluate("0")
            return panel.choice.query is not None

        places = iter([(620, 380), (560, 300), (700, 420), (500, 250), (600, 500)])
        page.until("a query", picks)
        drawn(page, opened)
        told = f"document.body.innerText.includes('query {panel.choice.query}')"
        page.until("its words", told)
        page.key("Escape", 27)
        page.until("no query", lambda: panel.choice.query is None)
        page.until("no words", f"!{told}")
        assert not page.errors
        outside = [urlsplit(r) for r in page.requests if not r.startswith(("data:", "blob:"))]
        assert {place.netloc for place in outside} == {address}


def opened(page, tmp_path, html):
    """The file of a page that is open."""
    file = tmp_path / "page.html"
    file.write_text(html)
    page.open(file.as_uri())
    return file


def assert_fits_a_phone(page):
    phone = {"width": 420, "height": 800, "deviceScaleFactor": 1, "mobile": True}
    page.call("Emulation.setDeviceMetricsOverride", **phone)
    assert page.evaluate("document.documentElement.scrollWidth") == 420
    page.call("Emulation.clearDeviceMetricsOverride")


def test_a_page_draws_and_asks_for_nothing(page, tmp_path):
    source = open_source(MODEL)
    file = opened(page, tmp_path, scene_html(source.scene_of(source.frames)))
    drawn(page)
    grey = (abs(page.picture() - 127.5).max(-1) < 1).mean()
    assert grey > 0.02  # the background of the model, not that of the page
    assert_alone(page, file)
    page.evaluate(
        "window.canvas = document.querySelector('canvas[data-engine]');"
        "window.engine = canvas.dataset.engine; delete canvas.dataset.engine;"
        "document.querySelector('#record').click()"  # before the scene is read
    )
    page.until("nothing", "document.querySelector('#record').textContent === 'record'")
    page.evaluate(
        "canvas.dataset.engine = engine;"
        "URL.createObjectURL = data => { window.film = data; return 'data:,'; };"
        "document.querySelector('#record').click()"
    )
    for place in range(400, 600, 10):
        page.drag(place, 300, 30)  # what stands still has no frames
    page.evaluate(
        "window.saved = document.querySelector('#record').textContent;"
        "document.querySelector('#record').click()"
    )
    page.until(
        "a film", "window.film?.size > 10000 && saved.endsWith(film.type.slice(6).split(';')[0])"
    )
    assert page.targets == ["worker"]  # it sorts the Gaussians as the page is turned
    assert not page.errors


def test_a_page_has_the_colors_of_several_directions(page, tmp_path, monkeypatch):
    """In the middle of one Gaussian."""
    for count, eye in ((3, (1.0, 1.5, 2.0)), (15, (-1.0, 2.0, -1.5))):
        sh = torch.linspace(-0.4, 0.3, 3 * count).view(1, 1, -1, 3)
        still = {"means": torch.zeros(1, 1, 3), "opacities": torch.ones(1, 1), "sh": sh}
        given = replace(cloud(1), **still)
        monkeypatch.setattr("qgs_viewer.page.first_eye", lambda _, eye=eye: (eye, (0, 0, 0)))
        opened(page, tmp_path, scene_html(QueryScene(given)))
        shown = drawn(page)[168, 310]
        values = harmonics(normalize(-torch.tensor(eye), dim=0), count)
        expected = 255 * (given.colors + values @ sh)[0, 0]
        assert shown == pytest.approx(expected.numpy(), abs=3)


# Turns the scene before it is there.
EARLY = """<script>addEventListener("DOMContentLoaded", () => {
    document.body.dispatchEvent(new Event("wheel", {bubbles: true}));
})</script>"""


def test_a_tour_stands_where_photos_were_taken(page, tmp_path):
    """Photos are negatives of what our renderer shows."""
    lens = (300.0, 300.0, 160.0, 100.0)
    cameras = pinhole(arc([-40.0, 0, 40], 3, 0.3).float(), lens, (200, 320))[None]
    given = cloud(200)
    photos = AutoRenderer(AutoRenderer.Config(background=(0, 0, 0)))(given, cameras).rgb
    names = ["</script><b>left</b>", "middle", "right"]
    errors = [rgb_picture(1 - photo.flip(-1)) for photo in photos[0]]
    tour = Tour("walk", "3 photos", Views(1 - photos, cameras), names, 2, cameras, errors)
    file = opened(page, tmp_path, gaussians_html(given, tour) + EARLY)
    page.until("the scene", "window.tour && !document.querySelector('#veil')")
    buttons = "[...document.querySelectorAll('#tour nav button')]"
    shown = ["play", "record", "expected error", *names]
    assert page.evaluate(f"{buttons}.map(b => b.innerText)") == shown

    def away(images=photos):
        """Of the window above the buttons from each image, as a mean of differences."""
        drawn(page)
        shown = page.picture().astype(np.uint8)
        foot = page.evaluate("document.querySelector('#tour footer').offsetHeight")
        height = len(shown) - 2 * foot
        left = (shown.shape[1] - 1.6 * height) / 2
        box = (left, foot, left + 1.6 * height, foot + height)
        small = np.asarray(Image.fromarray(shown).resize((320, 200), Image.Resampling.BOX, box))
        colors = 255 * images[0].permute(0, 2, 3, 1).numpy()
        # viser's notice lies over the left
        return [abs(small - color)[20:180, 160:].mean() for color in colors]

    left, middle, _ = away()
    assert left < 4 < middle / 2
    page.evaluate(f"{buttons}[5].click()")
    *_, middle, right = away()
    assert right < 4 < middle / 2
    photo = "document.querySelector('#tour img')"
    assert page.evaluate(f"{photo}.hidden")
    page.evaluate(f"{buttons}[4].click()")
    assert not page.evaluate(f"{photo}.hidden")
    slider = "document.querySelector('#tour input')"
    page.evaluate(f"{slider}.value = 100; {slider}.oninput()")
    assert away(1 - photos)[1] < 1
    page.evaluate(f"{buttons}[2].click()")
    assert away(1 - photos.flip(-1))[1] < 3
    page.evaluate(f"{buttons}[2].click()")
    assert page.evaluate(f"{photo}.style.clipPath") == "inset(0px 0px 0px 100%)"
    still = page.picture()
    page.evaluate(f"{buttons}[0].click()")
    page.until("a flight", lambda: abs(page.picture() - still).mean() > 8)
    page.evaluate(f"{buttons}[0].click()")
    assert_fits_a_phone(page)
    assert not page.errors
    assert_alone(page, file)


def assert_alone(page, file):
    assert {urlsplit(request).scheme for request in page.requests} <= {"file", "data", "blob"}
    assert [r for r in page.requests if r.startswith("file:")] == [file.as_uri()]


def test_a_report(page, tmp_path):
    models = open_models([stand_in(tmp_path / f"{kind}.safetensors") for kind in PAIR], None, "cpu")
    file = opened(page, tmp_path, report_html(Comparison(models, {}, {}), model_scenes(models, 2)))
    page.until("the script", "document.readyState == 'complete' && !!window.theme.textContent")

    shown = "[...document.querySelectorAll('article')].map(a => a.checkVisibility())"
    assert page.evaluate(shown) == [True, False]
    page.evaluate("document.querySelectorAll('.scenes > label')[1].click()")
    assert page.evaluate(shown) == [False, True]
    page.evaluate("document.querySelector('.scenes > input:checked').focus()")
    page.key("ArrowLeft", 37)
    assert page.evaluate(shown) == [True, False]

    slide(page)
    pick(page)
    zoom(page)
    paper = "getComputedStyle(document.body).backgroundColor"
    white = "rgb(255, 255, 255)"
    press = "document.getElementById('theme').click()"
    assert page.evaluate(paper) == white
    page.evaluate(press)
    assert page.evaluate(paper) != white
    page.evaluate(press)
    assert page.evaluate(paper) == white

    assert_fits_a_phone(page)
    assert not page.evaluate("!!document.querySelector('iframe')")
    page.evaluate("document.querySelector('.open').click()")

    def drawn():
        left, top, width = box_of(page, "iframe")
        shot = page.picture()[top + 160 : top + 400, left : left + width]
        # the scene sorts its Gaussians in a worker
        return page.targets.count("worker") == 1 and shot.std() > 8

    page.until("the scene", drawn, 180)
    assert not page.errors
    assert_alone(page, file)


def box_of(page, element):
    """Its left, top and width in the window, to which it is scrolled."""
    page.evaluate(f"document.querySelector('{element}').scrollIntoView()")
    box = f"document.querySelector('{element}').getBoundingClientRect()"
    return [int(page.evaluate(f"{box}.{side}")) for side in ("left", "top", "width")]


def slide(page):
    left, top, width = box_of(page, ".compare > div")

    def shown():
        return page.picture()[top + 4 : top + 200, left + 4 : left + width - 4]

    page.drag(left + width - 3, top + 50)
    truth = shown()
    page.drag(left + 3, top + 50)
    render = shown()
    value = "+document.querySelector('.compare input').value"
    assert page.evaluate(value) < 5
    page.key("PageUp", 33)
    assert 5 < page.evaluate(value) < 60
    assert abs(truth - render).mean() > 10

    at = {"x": left + width // 4, "y": top + 50}
    page.call("Input.dispatchTouchEvent", type="touchStart", touchPoints=[at])
    page.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
    assert 20 < page.evaluate(value) < 30


def pick(page):
    """The buttons below the large picture show another model and another view."""
    shown = "[...document.querySelectorAll('.compare:not([hidden]) img')].map(img => img.alt)"
    best = page.evaluate(shown)
    assert [text.partition(",")[0] for text in best] == ["photo", PAIR[0]]
    page.evaluate("document.querySelectorAll('[data-pick=model]')[1].click()")
    photo, render = page.evaluate(shown)
    assert photo == best[0]
    assert render.partition(",")[0] == PAIR[1]
    page.evaluate("document.querySelectorAll('[data-pick=view]')[1].click()")
    other, render = page.evaluate(shown)
    assert other != photo
    assert render.partition(",")[0] == PAIR[1]


def zoom(page):
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
