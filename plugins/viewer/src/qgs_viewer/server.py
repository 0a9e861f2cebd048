"""A viser server that prints nothing, and where its viewers first stand in a scene."""

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
from qgs_viewer.look import Look
from qgs_viewer.stage import FRUSTUM, distance_to

FIELD_OF_VIEW = 0.95  # of the viewer's window, vertical, radians
SHORT = 0.3  # length of the mean of unit vectors below which they have no direction in common


@contextmanager
def quiet_server(
    host: str = "127.0.0.1", port: int = 0, label: str | None = None
) -> Iterator[viser.ViserServer]:
    """A running server, at the next free port from `port` on; 0 takes any.

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
        sockets.serve = serve
    try:
        yield server
    finally:
        with redirect_stdout(io.StringIO()):
            server.stop()


def foreign(headers: Headers, host: str) -> bool:
    """Whether a request comes from another page, or by a name that is not the server's.

    Another page that is open in the browser could read the scene; under a name of its own that
    resolves to this machine (DNS rebinding) it would look like this one. Addresses in digits, the
    names of this machine and `host` are the server's.
    """
    named, origin = headers.get("Host", ""), headers.get("Origin")
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
            status, text = http.HTTPStatus.FORBIDDEN, b"Open the address that qgs view printed.\n"
            length = Headers({"Content-Length": str(len(text))})
            return Response(status, status.phrase, length, text)
        return process_request(connection, request)

    return serve(*where, process_request=checked, **options)


def stand(server: viser.ViserServer, look: Look) -> None:
    """New viewers stand behind and above the input cameras, or before a scene without cameras."""
    eye, target = first_eye(look)
    up = up_of(look).numpy()
    server.scene.set_up_direction(up)
    server.initial_camera.position, server.initial_camera.look_at = eye, target
    server.initial_camera.up, server.initial_camera.fov = up, FIELD_OF_VIEW


def up_of(look: Look) -> torch.Tensor:
    """Up for the input cameras together, unit (3,), shown world; -y without cameras."""
    if look.views is None:
        return torch.tensor([0.0, -1.0, 0.0]).double()
    down = look.views.cameras.c2w[0, :, :3, 1].cpu().double()
    mean = down.mean(0)
    mean = mean if mean.norm() >= SHORT else down[0]
    return -(look.placement.rotation @ F.normalize(mean, dim=0))


def first_eye(look: Look) -> tuple[np.ndarray, np.ndarray]:
    """Where the viewer stands at first and what it looks at, both (3,), shown world.

    Behind cameras that look the same way; outside of those that surround something; of a walk at
    the camera in its middle, before its photo, since walls may stand behind it.
    """
    middle = look.placement.points(look.gaussians.means[0]).median(0).values
    unit = distance_to(look)
    if look.views is None:
        return (middle - torch.tensor([0.0, 0.0, 2.5 * unit])).numpy(), middle.numpy()
    c2w, up = look.views.cameras.c2w[0].cpu().double(), up_of(look)
    eyes = look.placement.points(c2w[:, :3, 3])
    eye, forward = eyes.mean(0), look.placement.rotation @ c2w[:, :3, 2].mean(0)
    apart = (eyes - eye).norm(dim=-1)
    if apart.max() > unit and not look_at_depth(c2w):
        ahead = unit * look.placement.rotation @ c2w[apart.argmin(), :3, 2]
        eye = eyes[apart.argmin()] + 2 * FRUSTUM * ahead
        return eye.numpy(), (eye + ahead).numpy()
    if forward.norm() < SHORT:
        away = 1.5 * max(float((eyes - middle).norm(dim=-1).max()), unit)
        ahead = look.placement.rotation @ c2w[0, :3, 2]
        return (middle + away * (0.3 * up - ahead)).numpy(), middle.numpy()
    aside = look.placement.rotation @ c2w[0, :3, 0]
    place = eye - 0.3 * unit * forward + 0.2 * unit * aside + 0.2 * unit * up
    return place.numpy(), (eye + unit * forward).numpy()
