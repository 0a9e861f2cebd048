"""The viewer in a real browser: it opens, draws, picks, follows layers, takes other photos."""

import io
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from browser import CHROMIUM, Page, chromium
from PIL import Image
from qgs_viewer.page import scene_html
from qgs_viewer.panel import Panel
from qgs_viewer.server import quiet_server
from qgs_viewer.sources import Wanted, open_source

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium: apt install chromium"),
]
MODELS = ("rooms/locus-64", "rooms/tokengs-64")
SCENE = (slice(160, 640), slice(330, 930))  # of the window: no panel, no notice


def picture(page: Page, folder: Path, name: str) -> np.ndarray:
    shot = page.screenshot(folder / f"{name}.png")
    return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB"))[SCENE].astype(int)


def drawn(page: Page, folder: Path, name: str, unlike: np.ndarray | None = None) -> np.ndarray:
    """The scene once it stands still, has colours, and is another than before."""
    last, end = picture(page, folder, name), time.monotonic() + 90
    while time.monotonic() < end:
        time.sleep(1)
        now = picture(page, folder, name)
        differs = unlike is None or (np.abs(now - unlike).max(-1) > 24).mean() > 0.005
        if now.std() > 4 and differs and np.abs(now - last).max(-1).mean() < 0.5:
            return now
        last = now
    raise AssertionError(f"{name} was not drawn; see {folder}, {page.errors}")


def network(page: Page, own: str) -> list[str]:
    return [r for r in page.requests if not r.startswith(("data:", "blob:", own))]


@pytest.mark.parametrize("model", MODELS)
def test_the_viewer(model: str, tmp_path: Path) -> None:
    source = open_source(model, Wanted())
    source.title = "<b id=named>*name*</b> 1. [x](y)"
    with quiet_server() as server, chromium(tmp_path / "profile") as page:
        panel = Panel(server, source)
        address = f"127.0.0.1:{server.get_port()}"
        page.open(f"http://{address}")
        page.until("the canvas", "!!document.querySelector('canvas')")
        opened = drawn(page, tmp_path, "opened")
        page.until("its name", f"document.body.innerText.includes({source.title!r})")
        assert page.evaluate("document.querySelector('#named')") is None

        for x, y in ((620, 380), (560, 300), (700, 420), (500, 250), (600, 500)):
            page.click(x, y)
            if waited(page, lambda: panel.choice.query is not None):
                break
        assert panel.choice.query is not None
        picked = drawn(page, tmp_path, "picked", opened)
        told = f"query {panel.choice.query}"
        page.until("its words", f"document.body.innerText.includes('{told}')")

        page.key("Escape", 27)
        page.until("no query", lambda: panel.choice.query is None)
        page.until("no words", f"!document.body.innerText.includes('{told}')")
        panel.pick(int(told.split()[1]))
        page.until("its words again", f"document.body.innerText.includes('{told}')")

        page.evaluate("document.querySelector('[role=slider]').focus()")
        for _ in range(panel.look.depth - 1):
            page.key("ArrowLeft", 37)
            time.sleep(1)  # every step is a message of its own
        page.until("the layer", lambda: panel.choice.layer == 1)
        if model == MODELS[0]:
            drawn(page, tmp_path, "layer", picked)

        before = panel.look
        box = "[...document.querySelectorAll('input[type=checkbox]')].at(-1)"
        page.evaluate(f"({box}).click()")
        page.until("another look", lambda: panel.look is not before)
        assert len(panel.look.frames) == 3
        drawn(page, tmp_path, "inputs")
        assert page.errors == []
        assert all(address in request for request in network(page, "http://none"))


def turned(page: Page, x: float) -> None:
    for kind, place in (("mousePressed", x), ("mouseMoved", x + 30), ("mouseReleased", x + 30)):
        page.call("Input.dispatchMouseEvent", type=kind, x=place, y=300, button="left", buttons=1)


def waited(page: Page, happened: Callable[[], bool]) -> bool:
    try:
        return bool(page.until("it", happened, 10))
    except AssertionError:
        return False


def test_a_page_draws_and_asks_for_nothing(tmp_path: Path) -> None:
    source = open_source(MODELS[0], Wanted())
    file = tmp_path / "scene.html"
    file.write_text(scene_html(source.look(source.frames)), encoding="utf-8")
    with chromium(tmp_path / "profile") as page:
        page.follow_frames()
        page.open(file.as_uri())
        page.until("the canvas", "!!document.querySelector('canvas')")
        drawn(page, tmp_path, "page")
        shot = np.asarray(Image.open(tmp_path / "page.png").convert("RGB")).astype(int)
        grey = (np.abs(shot - 127.5).max(-1) < 1).mean()
        assert grey > 0.02, "the background of the model, not that of the page"
        assert network(page, file.as_uri()) == []
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
            turned(page, place)  # what stands still has no frames
        page.evaluate(
            "window.saved = document.querySelector('#record').textContent;"
            "document.querySelector('#record').click()"
        )
        page.until(
            "a film",
            "window.film?.size > 10000 && saved.endsWith(film.type.slice(6).split(';')[0])",
        )
        assert page.targets == ["worker"], "it sorts the Gaussians as the page is turned"
        assert page.errors == []
