"""Random materials of a room, in matching colours; materials.toml lists the kinds."""

import colorsys
import tomllib
from collections.abc import Sequence
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from qgs_worlds.caster import patterns
from qgs_worlds.caster.tables import TEXTURE

Color = Sequence[float]


def kinds_beside(module: str) -> dict[str, Any]:
    """Read the TOML file beside a Python file, which has its name; it explains its keys."""
    return tomllib.loads(Path(module).with_suffix(".toml").read_text("utf-8"))


_KINDS = kinds_beside(__file__)
_FIXED: dict[str, Color] = {"white": (0.95, 0.94, 0.91), "dark": (0.10, 0.09, 0.09)}
_WOODS: list[Color] = _KINDS["floor"]["kinds"][0]["paints"]["board"]["any"]


def toned(color: Color, factor: float) -> Color:
    """Return `color` times `factor`, with values of at most 1: darker if `factor` < 1."""
    return [min(part * factor, 1.0) for part in color]


def between(rng: Random, value: float | Sequence[float]) -> float:
    """Return `value` if it is a number; return a uniform random number if it is [low, high]."""
    return value if isinstance(value, int | float) else rng.uniform(*value)


class Materials:
    """Random textures of one room, in a few matching hues."""

    def __init__(self, rng: Random) -> None:
        self.rng = rng
        self._rows: list[np.ndarray] = []
        # neighbouring hues, an opposite one and a third one match
        base = rng.random()
        self._hues = [(base + step + 0.04 * rng.gauss(0, 1)) % 1 for step in (0.0, 0.08, 0.5, 0.35)]
        self._wood = rng.choice(_WOODS)

    def material(self, name: str) -> int:
        """Add a random material of the kind `name` in materials.toml, and return its index."""
        rng = self.rng
        paints = dict(_FIXED)
        kind = _KINDS[name]
        row = np.zeros((), TEXTURE)
        self._rows.append(row)
        self._pattern(row, kind, paints)
        if "kinds" in kind:
            pick = rng.random()
            one = next(one for one in kind["kinds"] if pick < one["below"])
            self._pattern(row, one, paints)
            kind = kind | one
        row["period"] = between(rng, kind["period"])
        row["seed"] = rng.random() * 65536
        row["emission"] = kind.get("emission", 0.0)
        row["colors"][:3] = [toned(paints[paint], factor) for paint, factor in kind["colors"]]
        return len(self._rows) - 1

    def textures(self, first: Sequence[int]) -> np.ndarray:
        """Return a table of TEXTURE for the ray caster, one row for each material.

        first: indices of materials whose rows are repeated at the start, before all materials.
        """
        return np.stack([self._rows[i] for i in first] + self._rows)

    def _pattern(self, row: np.ndarray, kind: dict[str, Any], paints: dict[str, Color]) -> None:
        """Choose a random pattern for a kind of material, and add its colours to `paints`.

        row: row of TEXTURE, which gets the pattern if the kind has one.
        """
        names = kind.get("patterns", [])
        if names:
            # a choice among one would consume a random number
            name = self.rng.choice(names) if len(names) > 1 else names[0]
            row["pattern"] = getattr(patterns, name)
        for paint, how in kind.get("paints", {}).items():
            paints[paint] = self._paint(how, paints)

    def _paint(self, how: dict[str, Any], paints: dict[str, Color]) -> Color:
        rng = self.rng
        if "hue" in how:
            hue = self._hues[int(rng.random() * len(self._hues))]
            saturation, value = (rng.uniform(*part) for part in how["hue"])
            return colorsys.hsv_to_rgb(hue, saturation, value)
        if "any" in how:
            return rng.choice(how["any"])
        if "wood" in how:
            return toned(self._wood, rng.uniform(*how["wood"]))
        if "of" in how:
            return toned(paints[how["of"]], rng.choice(how["by"]))
        return [between(rng, part) for part in how["rgb"]]
