"""What a user chose to see, and how Gaussians are painted by it."""

import colorsys
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from qgs.drawing.figures import INK, Color
from qgs_viewer.look import Look
from qgs_viewer.placement import Splats

Others = Literal["shown", "faint", "hidden"]
DARK = 0.3  # mean of a background below which dark lines could not be seen
FAINT = 0.12  # opacity of the Gaussians of other queries, as a part of their own
_PALE = 0.4  # part of the background in the colours of Gaussians that are not picked


@dataclass(frozen=True)
class Choice:
    """What is shown. query: the picked one. layer: of supports and attention, 0 the start.

    others: how Gaussians of other queries look. patches: number of lines to those that are read.
    """

    by_query: bool = False
    query: int | None = None
    layer: int = 0
    others: Others = "faint"
    patches: int = 24
    anchors: bool = True
    photos: bool = True


def query_color(query: int) -> Color:
    """A colour of its own for each query; neighbours in number differ much (golden ratio)."""
    hue, light = (query * 0.61803398875) % 1, (0.45, 0.6, 0.52)[query % 3]
    red, green, blue = colorsys.hls_to_rgb(hue, light, 0.8)
    return round(red * 255), round(green * 255), round(blue * 255)


def look_colors(look: Look) -> np.ndarray:
    """`query_color` of every query, uint8 (N, 3)."""
    return np.array([query_color(query) for query in range(look.queries)], np.uint8).reshape(-1, 3)


def anchor_colors(look: Look, choice: Choice) -> tuple[np.ndarray, np.ndarray]:
    """Which anchors are shown, by number, and their colours uint8."""
    colors, numbers = look_colors(look), np.arange(look.queries)
    if choice.query is None or choice.others == "shown":
        return numbers, colors
    if choice.others == "hidden":
        return numbers[[choice.query]], colors[[choice.query]]
    paled = faded(colors, 0.3, look)
    paled[choice.query] = colors[choice.query]
    return numbers, paled


def faded(colors: np.ndarray | Color, strength: float | np.ndarray, look: Look) -> np.ndarray:
    """uint8 colours mixed with the background of `look`; strength 0 is the background alone."""
    mixed = strength * np.array(colors) + (1 - strength) * 255 * np.array(look.background)
    return mixed.round().astype(np.uint8)


def ink(look: Look) -> Color:
    """The colour of lines that stand out from the background of `look`."""
    return INK if np.mean(look.background) > DARK else (235, 235, 235)


def painted(look: Look, choice: Choice) -> Splats:
    """The Gaussians of `look`, coloured and faded as was chosen."""
    found, queries = look.splats, look.queries
    if not queries:
        return found
    colors, opacities = found.colors, found.opacities
    if choice.by_query:
        colors = look_colors(look).repeat(len(colors) // queries, 0).astype(np.float32) / 255
    if choice.query is not None and choice.others != "shown":
        mine = np.zeros(len(colors), bool)
        mine[look.members(choice.query)] = True
        part = FAINT if choice.others == "faint" else 0.0
        opacities = np.where(mine[:, None], np.maximum(opacities, 0.5), opacities * part)
        greys = colors.mean(1, keepdims=True) * (1 - _PALE) + np.array(look.background) * _PALE
        colors = np.where(mine[:, None], colors, greys)
    kinds = {"colors": colors, "opacities": opacities}
    return replace(found, **{name: part.astype(np.float32) for name, part in kinds.items()})
