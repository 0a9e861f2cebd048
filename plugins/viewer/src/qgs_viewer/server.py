"""A server of viser that says nothing itself, and where it first stands in a scene."""

import io
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout

import numpy as np
import torch
import viser

from qgs_viewer.look import Look
from qgs_viewer.stage import distance_to

FIELD_OF_VIEW = 0.95
"""Of the viewer's window, vertical, radians."""


@contextmanager
def quiet_server(
    host: str = "127.0.0.1", port: int = 0, label: str | None = None
) -> Iterator[viser.ViserServer]:
    """A running server, at the next free port from `port` on; 0 takes any."""
    with redirect_stdout(io.StringIO()):  # viser prints a box of addresses, whatever it is asked
        server = viser.ViserServer(host=host, port=port, label=label, verbose=False)
    try:
        yield server
    finally:
        with redirect_stdout(io.StringIO()):
            server.stop()


def stand(server: viser.ViserServer, look: Look) -> None:
    """New viewers stand behind and above the input cameras, or before a scene without cameras."""
    eye, target = first_eye(look)
    server.initial_camera.position, server.initial_camera.look_at = eye, target
    server.initial_camera.up, server.initial_camera.fov = (0.0, -1.0, 0.0), FIELD_OF_VIEW


def first_eye(look: Look) -> tuple[np.ndarray, np.ndarray]:
    """Where the viewer stands at first and what it looks at, both (3,), shown world."""
    middle = look.placement.points(look.gaussians.means[0]).median(0).values
    unit = distance_to(look)
    if look.views is None:
        return (middle - torch.tensor([0.0, 0.0, 2.5 * unit])).numpy(), middle.numpy()
    c2w = look.views.cameras.c2w[0]
    eye = look.placement.points(c2w[:, :3, 3]).mean(0)
    forward = look.placement.rotation @ c2w[:, :3, 2].mean(0).cpu().double()
    aside = look.placement.rotation @ c2w[0, :3, 0].cpu().double()
    up = -(look.placement.rotation @ c2w[0, :3, 1].cpu().double())
    place = eye - 0.3 * unit * forward + 0.2 * unit * aside + 0.2 * unit * up
    return place.numpy(), (eye + unit * forward).numpy()
