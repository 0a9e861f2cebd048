"""The panel, its scene and its server without a browser; pages, notebooks, `qgs view`."""

import http.client
import json
import math
import re
import time
from contextlib import suppress
from dataclasses import replace
from html import unescape
from io import BytesIO
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import viser
from commands import done
from numpy.testing import assert_allclose
from PIL import Image
from qgs_viewer.drawing import Choice, Drawing
from qgs_viewer.notebook import prediction_png, show_pictures
from qgs_viewer.page import Tour, gaussians_html, quiet_server, scene_html
from qgs_viewer.panel import Panel, plain
from qgs_viewer.query_scene import QueryScene
from small import QUERIES, model_of, model_scenes_of, sample_of, source_of
from tables import must_refuse
from viser.transforms import SO3
from walk import arc, cloud, pinhole
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

import qgs
from qgs.types import Views


@pytest.fixture(scope="module")
def server():
    with quiet_server() as server:
        yield server


def panel_of(server, source):
    server.scene.reset()
    server.gui.reset()
    return Panel(server, source)


@pytest.fixture
def panel(server):
    return panel_of(server, source_of("locus"))


BASE = {"gaussians", "views/0", "views/1"}


def nodes(panel):
    names = BASE | {"views/2", "anchors", "support", "path", "reading"}
    return {name for name in names if panel.server.scene.get_handle_by_name(f"/{name}")}


def test_a_query_is_picked_and_followed_through_the_layers(server, panel):
    assert nodes(panel) == BASE | {"anchors"}
    panel.pick(3)
    assert nodes(panel) == BASE | {"anchors", "support", "path", "reading"}
    assert panel.number.value == 3
    assert all(picture.visible for picture in panel.pictures.values())
    for layer in range(panel.scene.depth, -1, -1):
        panel.layer.value = layer
        assert panel.choice.layer == layer
        ball = server.scene.get_handle_by_name("/support")
        support = panel.scene.support(layer)
        assert_allclose(ball.position, support.centers[0, 3], 0, 1e-4)
        # the unit ball, scaled, turned and moved, has the semi-axes of the support as columns
        axes = SO3(np.array(ball.wxyz)).as_matrix() * ball.scale
        assert_allclose(axes, support.axes[0, 3], 0, 1e-4)
    assert nodes(panel) == BASE | {"anchors", "support"}
    assert not any(picture.visible for picture in panel.pictures.values())
    panel.number.value = -1
    assert nodes(panel) == BASE | {"anchors"}


def test_text_is_shown_as_it_is(server):
    text = "<script>alert(1)</script> *a* _b_ [c](d) `e` {f} # ~~g~~ | \\ &lt;"
    assert re.sub(r"&#\d+;", "", plain(text)).replace(" ", "").isalnum()
    assert unescape(plain(text)) == text
    assert plain("1. a\n\n    b") == "1&#46; a b"
    source = source_of("locus")
    source.title = f"title {text}"
    source.notes = (f"note {text}",)
    panel_of(server, source)
    handles = [*server.gui._container_handle_from_uuid["root"]._children.values()]
    for handle in handles:
        handles += getattr(handle, "_children", {}).values()
    contents = "".join(x.content for x in handles if isinstance(x, viser.GuiMarkdownHandle))
    assert "title " in contents
    assert "note " in contents
    assert "<script" not in contents


def test_a_click_beside_everything_lets_a_query_go(panel):
    panel.pick(3)
    nowhere = SimpleNamespace(ray_origin=(0.0, 0.0, -3.0), ray_direction=(0.0, 0.0, -1.0))
    for _ in range(2):
        panel._clicked(nowhere)
        assert panel.choice.query is None
        assert panel.number.value == -1
    assert nodes(panel) == BASE | {"anchors"}


def test_gaussians_stand_before_the_background_of_their_model(server):
    """In a browser and in pages alike: what a scene serialises is what a page draws."""
    background = (0.0, 0.25, 1.0)
    scene = replace(model_scenes_of("locus").scene, background=background)
    Drawing(server.scene).put(scene, Choice())
    messages = server._websock_server._broadcast_buffer.message_from_id.values()
    (sent,) = [m for m in messages if type(m).__name__ == "BackgroundImageMessage"]
    assert sent.format == "png"
    pixels = np.asarray(Image.open(BytesIO(sent.rgb_data)).convert("RGB"))
    assert abs(pixels - 255 * np.array(background)).max() <= 1


def test_a_model_without_anchors_has_the_rest(server):
    panel = panel_of(server, source_of("tokengs"))
    panel.pick(3)
    assert nodes(panel) == BASE | {"reading"}
    assert {p for p, picture in panel.pictures.items() if picture.visible} == {"content", "weights"}


def test_other_inputs_make_another_scene_at_once(panel):
    before = panel.scene.gaussians.means.clone()
    panel.pick(3)
    panel.boxes[0].value = True
    assert panel.scene.frames == (0, 1, 4)
    assert nodes(panel) >= {"views/2", "support", "reading"}
    assert not torch.equal(panel.scene.gaussians.means, before)
    for box in panel.boxes:
        box.value = False
    assert panel.scene.frames == (4,)  # none at all is refused: the last scene stays
    assert "views/1" not in nodes(panel)


def ray_to(place):
    eye = np.array([0.0, 0.0, -3.0])
    return eye, (place - eye) / np.linalg.norm(place - eye)


def test_a_click_picks_by_anchor_or_by_gaussian(panel):
    centers = panel.scene.support(panel.scene.depth).centers[0].numpy()
    for center in centers:
        eye, way = ray_to(center)
        near = centers[panel.under(eye, way)] - center
        assert np.linalg.norm(near - near @ way * way) <= panel.drawing.anchor_radius * 1.01
    panel.choose(anchors=False)
    gaussian = panel.scene.gaussians.opacities[0].argmax()
    assert panel.under(*ray_to(panel.scene.splats.centers[gaussian])) is not None
    assert panel.under(*ray_to([0, 0, -4])) is None


def test_a_page_is_small_and_asks_for_nothing():
    page = scene_html(QueryScene(cloud(4096)))
    without_data = re.sub(r'__VISER_EMBED_DATA__="[^"]*"', "", page)
    assert len(without_data) < len(page) < 2_000_000
    outside = r"""(?:src|href)\s*=\s*["']?(https?:)?//|<link rel="stylesheet"""
    assert not re.search(outside, without_data)


def test_a_tour_lists_cameras_and_names():
    cameras = pinhole(arc([-20.0, 20], 3).float(), (60.0, 50.0, 32.0, 24.0), (48, 64))[None]
    views = Views(torch.rand(1, 2, 3, 48, 64), cameras)
    black = [np.zeros((48, 64, 3), np.uint8)] * 2
    page = gaussians_html(cloud(64), Tour("a", "b", views, ["</script>", "c"], 1, cameras, black))
    tour = json.loads(re.search("window.tour = (.*);</script>", page)[1])
    first, last = tour["stops"]
    assert first["name"] == "</script>"
    assert "photo" in first
    assert "photo" not in last
    assert first["tangent"] == 24 / 50
    assert first["ratio"] == pytest.approx(64 / 60 / (48 / 50))
    target = cameras.c2w[0, 1] @ torch.tensor([0, 0, math.dist(last["eye"], last["target"]), 1])
    assert_allclose(last["target"], target[:3], atol=1e-6)


show_pictures()


def test_a_model_shows_its_components_and_their_sizes():
    html = qgs.compose("tiny/locus.yaml")._repr_html_()
    cells = re.findall("<td>(.*?)</td>", html)
    assert {"encoder", "qgs/multiview_vit", "locus/ray_biased"} <= {*cells}
    assert "parameters" in html.partition("<table>")[0]


def test_a_prediction_shows_its_picture_where_something_lies_before_the_origin():
    """A red and a green Gaussian, left and right of the axis."""
    prediction = model_of("tokengs")(sample_of().inputs)
    means = torch.tensor([[[-0.5, 0.0, 1.0], [0.5, 0.0, 1.0]]])
    colors = torch.eye(3)[None, :2]
    two = replace(cloud(2), means=means, opacities=torch.full((1, 2), 0.99), colors=colors)
    png = replace(prediction, gaussians=two)._repr_png_()
    picture = np.asarray(Image.open(BytesIO(png)))[:, :192].astype(int)
    redder = picture[..., 0] - picture[..., 1]
    assert np.nonzero(redder > 70)[1].max() < 96 < np.nonzero(redder < -70)[1].min()
    assert prediction_png(prediction.to("meta")) is None


@pytest.fixture
def ply(tmp_path):
    qgs.save_ply(cloud(5), tmp_path / "a.ply")
    return tmp_path / "a.ply"


@pytest.fixture
def opened(monkeypatch):
    """Addresses that would have been opened; the server ends at once."""
    found = []
    monkeypatch.setattr("webbrowser.open", found.append)
    monkeypatch.setattr(viser.ViserServer, "sleep_forever", lambda self: None)
    return found


def view(line):
    return done(f"view {line} --device cpu").output


def test_it_opens_the_browser_unless_told_not_to(ply, opened):
    told = view(f"{ply} --port 0")
    assert [address in told for address in opened] == [True]
    view(f"{ply} --port 0 --no-open")
    assert len(opened) == 1


def test_a_page_shows_the_query_that_was_asked_for(opened, tmp_path):
    model, plain, picked, none = (tmp_path / name for name in ("m.safetensors", *"abc"))
    qgs.save(model_of("locus", "data.image_size=[16, 16]"), model)
    view(f"{model} --html {plain}")
    for where in (f"--html {picked}", "--port 0"):
        view(f"{model} {where} --query 3")
    assert picked.read_text() != plain.read_text()
    query = f"--query {QUERIES}"
    for where in (f"--html {none}", "--port 0"):
        must_refuse(query, view, f"{model} {where} {query}")
    assert not none.exists()


def test_a_page_never_replaces_a_file(ply, opened, tmp_path):
    page = tmp_path / "page.html"
    line = f"{ply} --html {page}"
    view(line)
    page.write_text("mine")
    must_refuse(None, view, line, kind=FileExistsError)
    assert page.read_text() == "mine"
    assert not opened


def connected(server, origin=None):
    protocol = f"viser-v{viser.__version__}"
    return connect(f"ws://127.0.0.1:{server.get_port()}", origin=origin, subprotocols=[protocol])


def test_the_page_is_served_under_names_of_this_machine_alone(server):
    port = server.get_port()
    for hosts, status in (
        (("localhost:{}", "127.0.0.1:{}", "[::1]:{}", "192.168.1.7:{}"), 200),
        (("rebound.example:{}", "127.0.0.1.example:{}", ""), 403),
    ):
        for host in hosts:
            connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
            connection.request("GET", "/", headers={"Host": host.format(port)})
            assert connection.getresponse().status == status, host


def test_its_own_page_alone_reads_the_scene(server):
    with connected(server, f"http://127.0.0.1:{server.get_port()}") as socket:
        assert socket.recv(10)
    for origin in ("http://127.0.0.1:1", "https://page.example", "null"):
        with pytest.raises(InvalidStatus):
            connected(server, origin)


def test_a_broken_message_ends_its_connection_alone(server, capfd, caplog):
    for message in (b"\xc1", b"", b"\x81\xa4type\xa4None", "text", b"\x00" * 99):
        with connected(server) as socket, suppress(TimeoutError, ConnectionClosed):
            socket.send(message)
            while True:
                socket.recv(0.5)
        time.sleep(0.1)
        with connected(server) as socket:
            assert socket.recv(10)
    assert "Traceback" not in "".join(capfd.readouterr())
    assert not [record for record in caplog.records if record.exc_info]
