"""A viser server that prints nothing, and the place of its viewers at first."""

import http
import io
import ipaddress
import logging
import socket
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from functools import partial
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import torch
import torch.nn.functional as F
import viser
import websockets.asyncio.server as sockets
from websockets.datastructures import Headers
from websockets.http11 import Response

from qgs.geometry.poses import look_at_depth
from qgs_viewer.drawing import FRUSTUM, distance_to
from qgs_viewer.query_scene import QueryScene

# Vertical angle of the viewer's window, radians.
FIELD_OF_VIEW = 0.95
# Length of the mean of unit vectors below which they have no direction in common.
SHORT = 0.3


@contextmanager
def quiet_server(
    host: str = "127.0.0.1", port: int = 0, label: str | None = None
) -> Iterator[viser.ViserServer]:
    """Run a server, at the next free port from `port` on; 0 takes any.

    Only its own page may connect to it, see `foreign`.
    """
    # a message that is none ends its connection, which is no news
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
    serve = sockets.serve
    sockets.serve = partial(_guarded, serve, host)  # viser has no option for this
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


def foreign(headers: Headers, host: str) -> bool:
    """Return if a request comes from another page, or by a name that is not the server's.

    Another page that is open in the browser could read the scene; under a name of its own that
    resolves to this machine (DNS rebinding) it would look like this one. Addresses in digits, the
    names of this machine and `host` are the server's.
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


def _guarded(serve: Any, host: str, *where: Any, process_request: Any, **options: Any) -> Any:
    """`websockets.asyncio.server.serve` that refuses `foreign` requests."""

    def checked(connection: Any, request: Any) -> Response | None:
        if foreign(request.headers, host):
            status = http.HTTPStatus.FORBIDDEN
            text = b"Open the address that qgs view printed.\n"
            length = Headers({"Content-Length": str(len(text))})
            return Response(status, status.phrase, length, text)
        return process_request(connection, request)

    return serve(*where, process_request=checked, **options)


def stand(server: viser.ViserServer, scene: QueryScene) -> None:
    """Have new viewers stand at `first_eye`."""
    eye, target = first_eye(scene)
    up = up_of(scene).numpy()
    server.scene.set_up_direction(up)
    camera = server.initial_camera
    camera.position = eye
    camera.look_at = target
    camera.up = up
    camera.fov = FIELD_OF_VIEW


def up_of(scene: QueryScene) -> torch.Tensor:
    """Return up for the input cameras together, unit (3,), shown world; -y without cameras."""
    if scene.views is None:
        return torch.tensor([0.0, -1.0, 0.0]).double()
    down = scene.views.cameras.c2w[0, :, :3, 1].cpu().double()
    mean = down.mean(0)
    if mean.norm() < SHORT:
        # cameras on their heads and feet: the first one decides
        mean = down[0]
    return -(scene.placement.rotation @ F.normalize(mean, dim=0))


def first_eye(scene: QueryScene) -> tuple[np.ndarray, np.ndarray]:
    """Return where the viewer stands at first and what it looks at, both (3,), shown world.

    Behind cameras that look the same way; outside of those that surround something; of a walk at
    the camera in its middle, before its photo, since walls may stand behind it.
    """
    middle = scene.placement.points(scene.gaussians.means[0]).median(0).values
    unit = distance_to(scene)
    if scene.views is None:
        return (middle - torch.tensor([0.0, 0.0, 2.5 * unit])).numpy(), middle.numpy()
    c2w = scene.views.cameras.c2w[0].cpu().double()
    up = up_of(scene)
    eyes = scene.placement.points(c2w[:, :3, 3])
    ahead = c2w[:, :3, 2] @ scene.placement.rotation.mT
    eye = eyes.mean(0)
    apart = (eyes - eye).norm(dim=-1)
    if apart.max() > unit and not look_at_depth(c2w):
        nearest = apart.argmin()
        target = eyes[nearest] + unit * ahead[nearest]
        return torch.lerp(eyes[nearest], target, 2 * FRUSTUM).numpy(), target.numpy()
    forward = ahead.mean(0)
    if forward.norm() < SHORT:
        away = 1.5 * max(float((eyes - middle).norm(dim=-1).max()), unit)
        return (middle + away * (0.3 * up - ahead[0])).numpy(), middle.numpy()
    # from a little behind, above and beside, depth is seen
    aside = scene.placement.rotation @ c2w[0, :3, 0]
    place = eye - 0.3 * unit * forward + 0.2 * unit * aside + 0.2 * unit * up
    return place.numpy(), (eye + unit * forward).numpy()
