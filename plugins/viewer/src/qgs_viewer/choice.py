"""The user's choice of what is shown, and how Gaussians are painted by it."""

import colorsys
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from qgs.drawing.figures import INK, Color
from qgs_viewer.placement import Splats
from qgs_viewer.query_scene import QueryScene

Others = Literal["shown", "faint", "hidden"]
# Mean of a background below which dark lines could not be seen.
DARK = 0.3
# Opacity of the Gaussians of other queries, as a part of their own.
FAINT = 0.12
# Part of the background in the colours of Gaussians that are not picked.
PALE = 0.4


@dataclass(frozen=True)
class Choice:
    """What is shown. query: the picked one. layer: of supports and attention, 0 the start.

    others: how Gaussians of other queries look. patches: number of lines to those that are read.
    """

    query: int | None = None
    by_query: bool = False
    layer: int = 0
    others: Others = "faint"
    patches: int = 24
    anchors: bool = True
    photos: bool = True


def query_color(query: int) -> Color:
    """Return a colour for a query; neighbours in number differ much."""
    # multiples of the golden ratio spread over the circle of hues however many there are
    hue = (query * 0.61803398875) % 1
    light = (0.45, 0.6, 0.52)[query % 3]
    red, green, blue = colorsys.hls_to_rgb(hue, light, 0.8)
    return round(red * 255), round(green * 255), round(blue * 255)


def query_colors(scene: QueryScene) -> np.ndarray:
    """Return `query_color` of every query, uint8 (N, 3)."""
    colors = [query_color(query) for query in range(scene.queries)]
    return np.array(colors, np.uint8).reshape(-1, 3)


def anchor_colors(scene: QueryScene, choice: Choice) -> tuple[np.ndarray, np.ndarray]:
    """Return which anchors are shown, by number, and their colours, uint8."""
    colors = query_colors(scene)
    numbers = np.arange(scene.queries)
    if choice.query is None or choice.others == "shown":
        return numbers, colors
    if choice.others == "hidden":
        return numbers[[choice.query]], colors[[choice.query]]
    # anchors of others stay visible, so that they can still be clicked
    paled = faded(colors, 0.3, scene)
    paled[choice.query] = colors[choice.query]
    return numbers, paled


def faded(
    colors: np.ndarray | Color, strength: float | np.ndarray, scene: QueryScene
) -> np.ndarray:
    """Mix uint8 colours with the background of `scene`; strength 0 is the background alone."""
    mixed = strength * np.array(colors) + (1 - strength) * 255 * np.array(scene.background)
    return mixed.round().astype(np.uint8)


def ink(scene: QueryScene) -> Color:
    """Return the colour of lines that stand out from the background of `scene`."""
    return INK if np.mean(scene.background) > DARK else (235, 235, 235)


def painted(scene: QueryScene, choice: Choice) -> Splats:
    """Return the Gaussians of `scene`, coloured and faded as was chosen."""
    found = scene.splats
    if not scene.queries:
        return found
    colors = found.colors
    opacities = found.opacities
    # Gaussians are ordered by query, so colours repeat in blocks
    if choice.by_query:
        each = len(colors) // scene.queries
        colors = query_colors(scene).repeat(each, 0) / 255
    if choice.query is not None and choice.others != "shown":
        mine = np.zeros((len(colors), 1), bool)
        mine[scene.members(choice.query)] = True
        part = FAINT if choice.others == "faint" else 0.0
        # nearly clear Gaussians of the picked query would not be seen
        opacities = np.where(mine, np.maximum(opacities, 0.5), opacities * part)
        greys = colors.mean(1, keepdims=True) * (1 - PALE) + np.array(scene.background) * PALE
        colors = np.where(mine, colors, greys)
    return replace(found, colors=colors.astype(np.float32), opacities=opacities.astype(np.float32))
