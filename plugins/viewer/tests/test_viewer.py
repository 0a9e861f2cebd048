"""The scene in viser, without a browser."""

import re
from collections.abc import Iterator
from dataclasses import replace
from html import unescape
from io import BytesIO
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import viser
from PIL import Image
from qgs_viewer.choice import Choice
from qgs_viewer.look import Look
from qgs_viewer.page import scene_html
from qgs_viewer.panel import Panel, plain
from qgs_viewer.server import quiet_server
from qgs_viewer.stage import Stage
from small import QUERIES, source_of

from qgs.types import Gaussians


@pytest.fixture(scope="module")
def server() -> Iterator[viser.ViserServer]:
    with quiet_server() as server:
        yield server


@pytest.fixture
def panel(server: viser.ViserServer, request: pytest.FixtureRequest):
    server.scene.reset()
    server.gui.reset()
    return Panel(server, source_of(getattr(request, "param", "locus")))


def nodes(server: viser.ViserServer) -> set[str]:
    names = ("/gaussians", "/views/0", "/views/1", "/views/2", "/anchors", "/support", "/path")
    return {n for n in (*names, "/reading") if server.scene.get_handle_by_name(n) is not None}


BASE = {"/gaussians", "/views/0", "/views/1"}


def test_a_query_is_picked_and_followed_through_the_layers(server, panel) -> None:
    assert nodes(server) == {*BASE, "/anchors"}
    panel.pick(3)
    assert nodes(server) == {*BASE, "/anchors", "/support", "/path", "/reading"}
    assert panel.number.value == 3
    assert all(picture.visible for picture in panel.pictures.values())
    for layer in range(panel.look.depth + 1):
        panel.layer.value = layer
        assert panel.choice.layer == layer
        ball = server.scene.get_handle_by_name("/support")
        support = panel.look.support(layer)
        np.testing.assert_allclose(ball.vertices.mean(0), support.centers[0, 3].numpy(), atol=1e-4)
    panel.layer.value = 0
    assert nodes(server) == {*BASE, "/anchors", "/support"}
    assert not any(picture.visible for picture in panel.pictures.values())
    panel.number.value = -1
    assert nodes(server) == {*BASE, "/anchors"}


def test_text_is_shown_as_it_is(server) -> None:
    text = "<script>alert(1)</script> *a* _b_ [c](d) `e` {f} # ~~g~~ | \\ &lt;"
    assert re.sub(r"&#\d+;", "", plain(text)).replace(" ", "").isalnum()
    assert unescape(plain(text)) == text
    assert plain("1. a\n\n    b") == "1&#46; a b"
    server.gui.reset()
    source = source_of("locus")
    source.title, source.notes = f"title {text}", (f"note {text}",)
    Panel(server, source)
    contents = [
        handle.content
        for handle in all_handles(server.gui)
        if isinstance(handle, viser.GuiMarkdownHandle)
    ]
    assert sum("title " in content or "note " in content for content in contents) == 2
    assert "<script" not in "".join(contents)


def all_handles(gui: viser.GuiApi) -> Iterator[object]:
    waiting = list(gui._container_handle_from_uuid["root"]._children.values())
    while waiting:
        handle = waiting.pop()
        yield handle
        waiting += getattr(handle, "_children", {}).values()


def button_of(server: viser.ViserServer, label: str) -> viser.GuiButtonHandle:
    buttons = [h for h in all_handles(server.gui) if isinstance(h, viser.GuiButtonHandle)]
    (found,) = [button for button in buttons if button.label == label]
    return found


def test_a_picked_query_is_let_go(server, panel) -> None:
    button = button_of(server, "Show all (Esc)")
    assert not button.visible
    panel.pick(3)
    assert button.visible
    button.value = True
    assert (panel.choice.query, panel.number.value, button.visible) == (None, -1, False)
    panel.pick(3)
    nowhere = SimpleNamespace(ray_origin=(0.0, 0.0, -3.0), ray_direction=(0.0, 0.0, -1.0))
    panel._clicked(nowhere)
    assert panel.choice.query is None
    panel._clicked(nowhere)
    assert nodes(server) == {*BASE, "/anchors"}


@pytest.mark.parametrize("background", [(0.5, 0.5, 0.5), (0.0, 0.25, 1.0)])
def test_gaussians_stand_before_the_background_of_their_model(background) -> None:
    """In a browser and in pages alike: what a scene serialises is what a page draws."""
    look = replace(source_of("locus").look((1, 4)), background=background)
    with quiet_server() as own:
        Stage(own.scene).put(look, Choice())
        messages = own._websock_server._broadcast_buffer.message_from_id.values()
        (sent,) = [m for m in messages if type(m).__name__ == "BackgroundImageMessage"]
    assert sent.format == "png"
    pixels = np.asarray(Image.open(BytesIO(sent.rgb_data)).convert("RGB")).reshape(-1, 3)
    np.testing.assert_allclose(pixels, 255 * np.array([background] * len(pixels)), atol=1)


@pytest.mark.parametrize("panel", ["tokengs"], indirect=True)
def test_a_model_without_anchors_has_the_rest(server, panel) -> None:
    panel.pick(3)
    assert nodes(server) == {*BASE, "/reading"}
    assert {p for p, picture in panel.pictures.items() if picture.visible} == {"content", "result"}


def test_other_inputs_make_another_scene_at_once(server, panel) -> None:
    before = panel.look.gaussians.means.clone()
    panel.pick(3)
    panel.boxes[0].value = True
    assert panel.look.frames == (0, 1, 4)
    assert nodes(server) >= {"/views/2", "/support", "/reading"}
    assert not torch.equal(panel.look.gaussians.means, before)
    for box in panel.boxes:
        box.value = False
    assert panel.look.frames == (4,)  # none at all is refused: the last scene stays
    assert [box.value for box in panel.boxes] == [frame == 4 for frame in range(6)]
    assert nodes(server) >= {"/views/0"}
    assert "/views/1" not in nodes(server)


def test_a_click_picks_by_anchor_or_by_gaussian(panel) -> None:
    support = panel.look.support(panel.look.depth)
    eye = np.array([0.0, 0.0, -3.0])
    for query in range(QUERIES):
        way = support.centers[0, query].numpy() - eye
        found = panel.under(eye, way / np.linalg.norm(way))
        assert found is not None
        near = (support.centers[0, found] - support.centers[0, query]).numpy()
        side = near - (near @ way) / (way @ way) * way
        assert np.linalg.norm(side) <= panel.stage.anchor_radius * 1.01
    panel.choose(anchors=False)
    gaussian = int(panel.look.gaussians.opacities[0].argmax())
    way = panel.look.splats.centers[gaussian] - eye
    assert panel.under(eye, way / np.linalg.norm(way)) is not None
    assert panel.under(eye, np.array([0.0, 0.0, -1.0])) is None


def test_a_page_is_small_and_asks_for_nothing() -> None:
    count, make = 4096, torch.manual_seed(0)
    quats = torch.nn.functional.normalize(torch.randn(1, count, 4, generator=make), dim=-1)
    draw = (torch.rand(1, count, n, generator=make) for n in (3, 3, 3))
    means, scales, colors = draw
    gaussians = Gaussians(means, 0.05 * scales + 0.01, quats, torch.rand(1, count), colors)
    page = scene_html(Look(gaussians))
    assert len(page.encode()) < 2_000_000
    without_data = re.sub(r'__VISER_EMBED_DATA__="[^"]*"', "", page)
    assert len(without_data) < len(page)
    assert re.findall(r"""(?:src|href)\s*=\s*["']?(https?:)?//""", without_data) == []
    assert '<link rel="stylesheet"' not in without_data
    look = source_of("locus").look((1, 4))
    assert len(scene_html(look, Choice(query=2, layer=1))) < 2_000_000
