"""Show scenes in the browser: viser servers, first viewpoints, HTML pages of scenes."""

import base64
import http
import io
import ipaddress
import json
import logging
import socket
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass, replace
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import torch
import torch.nn.functional as F
import viser
import websockets.asyncio.server as sockets
from rich.console import Console

from qgs.drawing.images import Picture, rgb_picture
from qgs.files import refuse_existing, write_text
from qgs.geometry.poses import look_at_depth
from qgs.types import Cameras, Gaussians, Views
from qgs_viewer.drawing import FRUSTUM, Choice, Drawing, distance_to
from qgs_viewer.look import data_uri
from qgs_viewer.query_scene import QueryScene

# Vertical angle of the viewer's window, radians.
FIELD_OF_VIEW = 0.95


@contextmanager
def quiet_server(
    host: str = "127.0.0.1", port: int = 0, label: str | None = None, head: str = ""
) -> Iterator[viser.ViserServer]:
    """Run a viser server inside the block, without the lines that viser prints.

    port: the first port to try; if it is taken, the next free port is used. 0 takes any free port.
    label: title of the page. head: HTML for the beginning of the page's head. Only pages of this
    server may connect to it (see `foreign`).
    """
    # a message that is none ends its connection, which is no news
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
    serve = sockets.serve
    sockets.serve = partial(_guarded, serve, host, head)  # viser has no option for this
    try:
        # viser prints a box of addresses, whatever it is asked
        with redirect_stdout(io.StringIO()):
            server = viser.ViserServer(host=host, port=port, label=label, verbose=False)
    finally:
        # other servers of this process are not to be guarded by this host
        sockets.serve = serve
    try:
        yield server
    finally:
        with redirect_stdout(io.StringIO()):
            server.stop()


def foreign(headers: Mapping[str, str], host: str) -> bool:
    """Return True for a request to refuse: from a page of another server, or to a wrong host name.

    A page of another server, open in the same browser, could otherwise read the scene. The host
    name is checked too, because the other server may let its host name resolve to this machine
    (DNS rebinding). Right host names are IP addresses, localhost, the name of this machine, and
    `host`.
    """
    named = headers.get("Host", "")
    origin = headers.get("Origin")
    # browsers send it with every request of a page's script
    if origin is not None and urlsplit(origin).netloc != named:
        return True
    name = urlsplit(f"//{named}").hostname or ""
    if name in {"localhost", host.lower(), socket.gethostname().lower()}:
        return False
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return True
    return False


def _guarded(
    serve: Any, host: str, head: str, *where: Any, process_request: Any, **options: Any
) -> Any:
    """Call `serve` so that the server answers requests that are `foreign` with status 403.

    serve: the function `websockets.asyncio.server.serve`. host: address of the server. head: see
    `quiet_server`.
    """

    def checked(connection: Any, request: Any) -> Any:
        if foreign(request.headers, host):
            text = "Open the address that qgs view printed.\n"
            return connection.respond(http.HTTPStatus.FORBIDDEN, text)
        if head:
            # compressed text would have no place for it
            request.headers.pop("Accept-Encoding", None)
        answer = process_request(connection, request)
        if head and answer is not None:
            answer.body = with_head(answer.body.decode(), head).encode()
            # the page ends where the connection does
            answer.headers.pop("Content-Length", None)
        return answer

    return serve(*where, process_request=checked, **options)


def stand(server: viser.ViserServer, scene: QueryScene) -> None:
    """Set the camera from which a browser shows the scene at first (see `first_eye`)."""
    eye, target = first_eye(scene)
    up = up_of(scene).numpy()
    server.scene.set_up_direction(up)
    camera = server.initial_camera
    camera.position = eye
    camera.look_at = target
    camera.up = up
    camera.fov = FIELD_OF_VIEW


def up_of(scene: QueryScene) -> torch.Tensor:
    """Return the mean up direction of the input cameras, a unit vector (3,) in the viewer's world.

    Without cameras, the up direction is -y.
    """
    if scene.views is None:
        return torch.tensor([0.0, -1.0, 0.0]).double()
    down = scene.views.cameras.c2w[0, :, :3, 1].cpu().double().mean(0)
    return -F.normalize(down, dim=0)


def first_eye(scene: QueryScene) -> tuple[np.ndarray, np.ndarray]:
    """Return the first viewpoint and the point that it looks at, both (3,) in the viewer's world.

    The viewpoint lies a little behind the most central input camera. If the cameras are far apart
    and do not look at one point, the viewpoint lies in front of that camera, since a wall may be
    behind it.
    """
    unit = distance_to(scene)
    if scene.views is None:
        middle = scene.gaussians.means[0].detach().cpu().double().median(0).values
        return (middle - torch.tensor([0.0, 0.0, 2.5 * unit])).numpy(), middle.numpy()
    c2w = scene.views.cameras.c2w[0].cpu().double()
    eyes = c2w[:, :3, 3]
    apart = (eyes - eyes.mean(0)).norm(dim=-1)
    aside, _, forward, eye = c2w[apart.argmin(), :3].unbind(-1)
    target = eye + unit * forward
    if apart.max() > unit and not look_at_depth(c2w):
        return torch.lerp(eye, target, 2 * FRUSTUM).numpy(), target.numpy()
    # from a little behind, above and beside, depth is seen
    place = eye + unit * (0.2 * aside + 0.2 * up_of(scene) - 0.3 * forward)
    return place.numpy(), target.numpy()


@dataclass(frozen=True)
class Tour:
    """Views that a page of a scene offers, and the camera path that it plays.

    title, note: heading, and the line below it. stops: views (1, V) that have a button each; the
    page opens at the first. names: texts of the buttons. photos: number of stops, from the first,
    that can be compared with their photo. path: cameras (1, P). errors: maps of expected errors
    of the stops, as pictures.
    """

    title: str
    note: str
    stops: Views
    names: Sequence[str]
    photos: int
    path: Cameras
    errors: Sequence[Picture]

    def script(self, distance: float) -> str:
        """Return the tour as a script.

        distance: distance from the cameras to the points about which the reader turns the scene.
        """
        stops = [*_stations(self.stops.cameras, distance)]
        for index, (stop, name) in enumerate(zip(stops, self.names, strict=True)):
            stop["name"] = name
            stop["errors"] = data_uri(self.errors[index], photo=True)
            if index < self.photos:
                stop["photo"] = data_uri(rgb_picture(self.stops.images[0, index]), photo=True)
        path = [*_stations(self.path, distance)]
        content = {"title": self.title, "note": self.note, "stops": stops, "path": path}
        # names of files must not end the script
        text = json.dumps(content).replace("<", r"\u003c")
        return f"<script>window.tour = {text};</script>{template('tour.html')}"


def _stations(cameras: Cameras, distance: float) -> Iterator[dict[str, Any]]:
    """Yield positions, targets, up directions and lenses of cameras (1, V), for the script."""
    height, width = cameras.size
    for c2w, lens in zip(cameras.c2w[0].cpu().double(), cameras.intrinsics[0], strict=True):
        _, down, forward, eye = c2w[:3].unbind(-1)
        fx, fy, _, _ = lens.tolist()
        yield {
            "eye": eye.tolist(),
            "target": (eye + distance * forward).tolist(),
            "up": (-down).tolist(),
            "tangent": height / (2 * fy),
            "ratio": width / fx * fy / height,
        }


def scene_html(scene: QueryScene, choice: Choice | None = None, tour: Tour | None = None) -> str:
    """Return an HTML page that shows `scene` in 3D; a reader can turn the scene and record a video.

    The page takes 0.8 MB plus 40 bytes for each Gaussian, with harmonics 56 to 104. choice: what is
    shown; by default all Gaussians in their own colours, and the anchors after the last layer.
    tour: views for buttons, in place of photos in the scene.
    """
    shown = scene if tour is None else replace(scene, views=None)
    with quiet_server() as server:
        stand(server, scene)
        Drawing(server.scene).put(shown, choice or Choice(layer=scene.depth))
        page = server.get_scene_serializer().as_html()
    head = template("head.html")
    if tour:
        head += tour.script(distance_to(scene))
    # a picked query has colours of its own
    if choice is None or choice.query is None:
        head += harmonics_script(scene)
    return with_head(page, head)


def template(name: str) -> str:
    """Return the text of the file `name` in the folder `template`."""
    file = files("qgs_viewer") / "template" / name
    return file.read_text(encoding="utf-8")


def harmonics_script(scene: QueryScene) -> str:
    """Return scripts that add the spherical harmonics of `scene` to its colours in a page.

    The scripts must stand before viser's. They take 4 bytes for each coefficient of each Gaussian,
    and as much for its colour. Returns "" if the Gaussians have no harmonics.
    """
    gaussians = scene.gaussians
    if gaussians.sh is None:
        return ""
    colors = gaussians.colors[0, :, None].cpu()
    # viser's colours are from 0 to 1, which those of a scene may leave
    values = torch.cat([colors - colors.clamp(0, 1), gaussians.sh[0].cpu()], 1)
    most = float(values.abs().max()) + 1e-6
    # most coefficients are far smaller than the largest: 8 bits of their roots are closer
    roots = values.sign() * (values.abs() / most).sqrt()
    data = base64.b64encode((127 * roots + 128).round().byte().numpy().tobytes()).decode()
    content = f"{{most: {most}, count: {values.shape[1]}, data: '{data}'}}"
    return f"<script>window.harmonics = {content};</script>{template('harmonics.html')}"


def with_head(page: str, head: str) -> str:
    """Return a page of viser with `head` before viser's code, which reads what `head` changes."""
    return page.replace("<head>", f"<head>{head}", 1)


def write_page(scene: QueryScene, query: int | None, file: Path, console: Console) -> None:
    """Write an HTML page that shows `scene` to the new file `file`, and say so on the console.

    query: index of the picked query; None shows all. Raises ValueError for a query that does not
    exist, and FileExistsError if `file` exists.
    """
    scene.refuse_missing(query)
    page = scene_html(scene, Choice(query=query, layer=scene.depth))
    # it may have come into being since the command began
    refuse_existing(file)
    write_text(file, page)
    console.print(f"wrote {file}", soft_wrap=True)
    if scene.queries:
        console.print("--query picks a query for the page; leave out --html to pick by mouse.")


def gaussians_html(gaussians: Gaussians, tour: Tour) -> str:
    """Return an HTML page that shows Gaussians (1, G) over black from the views of `tour`."""
    scene = QueryScene(gaussians, tour.stops, background=(0.0, 0.0, 0.0))
    return scene_html(scene, tour=tour)
