"""The scene in viser, without a browser."""

import re
from collections.abc import Iterator

import numpy as np
import pytest
import torch
from qgs_viewer.look import Look
from small import QUERIES, source_of

from qgs.types import Gaussians

viser = pytest.importorskip(
    "viser", reason="viser is not installed: pip install query-gaussians-viewer"
)


@pytest.fixture(scope="module")
def server() -> Iterator["viser.ViserServer"]:
    from qgs_viewer.server import quiet_server

    with quiet_server() as server:
        yield server


@pytest.fixture
def panel(server: "viser.ViserServer", request: pytest.FixtureRequest):
    from qgs_viewer.panel import Panel

    server.scene.reset()
    server.gui.reset()
    return Panel(server, source_of(getattr(request, "param", "locus")))


def nodes(server: "viser.ViserServer") -> set[str]:
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


def test_controls_say_what_was_chosen(server, panel) -> None:
    panel.colors.value = "by query"
    assert panel.choice.by_query
    panel.photos.value = False
    assert server.scene.get_handle_by_name("/views").visible is False
    panel.anchors.value = False
    assert "/anchors" not in nodes(server)


def test_a_page_is_small_and_asks_for_nothing() -> None:
    from qgs_viewer.choice import Choice
    from qgs_viewer.page import scene_html

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
