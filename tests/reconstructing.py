"""Photos and a model of rooms to reconstruct them with, and what is told of their views."""

import pytest
from commands import saved
from photo_formats import noisy_photos

HOLDOUTS = {
    "": {3},
    "--holdout none": set(),
    "--holdout 1.png,3": {1, 3},
    "--frames 2,3": set(),  # 3 is the held-out one
}
"""Options, and the photos of the row that are then compared with."""


@pytest.fixture(scope="session")
def photos(tmp_path_factory):
    """A row of 7, 0.1 apart."""
    return noisy_photos(tmp_path_factory.mktemp("photos") / "row")


@pytest.fixture(scope="session")
def checkpoint(tmp_path_factory):
    return saved(tmp_path_factory.mktemp("rooms") / "rooms.safetensors", "rooms/procedural")


def kinds(record):
    """Of the frames of views: inputs, then those that are compared with."""
    return {view["frame"]: view["kind"] for view in record["views"]}
