"""Which scenes are packed for training and which for testing."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import TypeAlias

from qgs.contracts import SceneSource, Split


@dataclass(frozen=True)
class Place:
    """Where a source holds a scene: the split and the index in it."""

    split: Split
    index: int


Places: TypeAlias = Mapping[str, Place]
"""Scenes by name."""

Splits: TypeAlias = Mapping[Split, Places]
"""What is packed into which split."""


def own_splits(source: SceneSource) -> Splits:
    """The source's own splits; scenes that are in both are packed once, for training."""
    train = _places(source, "train")
    test = {name: place for name, place in _places(source, "test").items() if name not in train}
    return {"train": train, "test": test}


def splits_by_list(source: SceneSource, test_scenes: Collection[str]) -> Splits:
    """All scenes, those named for testing. Raises ValueError for names that no scene has."""
    places = _all(source)
    absent = [name for name in test_scenes if name not in places]
    if absent:
        raise ValueError(
            f"{len(absent)} of {len(test_scenes)} test scenes are not there: {_some(absent)}; the "
            f"{len(places)} scenes are called {_some(list(places))}. Correct the list, or take "
            "them out of it"
        )
    chosen = set(test_scenes)
    return {
        "train": {name: place for name, place in places.items() if name not in chosen},
        "test": {name: place for name, place in places.items() if name in chosen},
    }


def splits_by_number(source: SceneSource, every: int) -> Splits:
    """All scenes, every n-th of them for testing, beginning with scene n - 1."""
    numbered = list(enumerate(_all(source).items()))
    return {
        "train": dict(item for i, item in numbered if i % every != every - 1),
        "test": dict(item for i, item in numbered if i % every == every - 1),
    }


def _all(source: SceneSource) -> Places:
    splits = own_splits(source)
    return {**splits["train"], **splits["test"]}


def _places(source: SceneSource, split: Split) -> dict[str, Place]:
    places: dict[str, Place] = {}
    for index, name in enumerate(source.names(split)):
        if name in places:
            raise ValueError(
                f"two scenes are called {name!r}, and chunks tell scenes by their names: rename one"
            )
        places[name] = Place(split, index)
    return places


def _some(names: list[str]) -> str:
    return ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")
