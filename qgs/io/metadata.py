"""The metadata of our safetensors files, read as data that may be damaged or hostile."""

import json
import math
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import qgs
from qgs.composer import Recipe, RecipeError, resolve
from qgs.wording import name_shown

LARGEST = 50_000_000
"""Characters of one entry; states of runs with thousands of processes have fewer."""


class CheckpointError(ValueError):
    """A file that holds no weights that can be used; the message says why and what to do."""


def damaged(path: str | os.PathLike[str], what: str) -> CheckpointError:
    """The error for a file whose metadata are not what we wrote. what: which, and why."""
    return CheckpointError(
        f"{path} is damaged: {name_shown(what, 5000)}. Copy the file again from where it "
        "came, or take another checkpoint of the run"
    )


@contextmanager
def reading(path: str | os.PathLike[str], key: str) -> Iterator[None]:
    """Raise what goes wrong with the entry `key` inside the block as a CheckpointError."""
    try:
        yield
    except (RecipeError, CheckpointError):
        raise
    except Exception as error:  # hostile JSON makes anything of what is done with it
        kind = "nested too deep" if isinstance(error, RecursionError) else str(error)[:200]
        why = f"`{key}` in its metadata cannot be read ({type(error).__name__}: {kind})"
        raise damaged(path, why) from error


def mapping_in(
    metadata: Mapping[str, str], key: str, path: str | os.PathLike[str]
) -> dict[str, Any]:
    """The JSON mapping under `key`; raises CheckpointError."""
    with reading(path, key):
        if len(metadata[key]) > LARGEST:
            raise ValueError(f"{len(metadata[key]):,} characters")
        found = json.loads(metadata[key])
        if not isinstance(found, dict):
            raise TypeError(f"it holds {'null' if found is None else type(found).__name__}")
        return found


def number_in(state: Mapping[str, Any], name: str, kind: type = int) -> Any:
    """The finite number, 0 or more, of `kind` (int or float) that `state` has under `name`.

    Raises ValueError for anything else, KeyError for nothing.
    """
    value = state[name]
    if type(value) not in (kind, int) or not 0 <= value < math.inf:
        raise ValueError(f"{name} is {str(value)[:100]!r}")
    return value


def refuse_newer(
    metadata: Mapping[str, str], known: Mapping[str, int], version: str, path: Any
) -> None:
    """Raise CheckpointError for a file of a later format, or of one that it does not tell.

    known: key of each format to the one that this release knows. version: key of the release.
    """
    for key, ours in known.items():
        with reading(path, key):
            written = int(metadata[key][:20])
        if written > ours:
            raise CheckpointError(
                f"{path} was written by qgs {metadata.get(version, '?')[:50]} with {key} {written};"
                f" this is qgs {qgs.__version__}, which knows {ours}: install the newer qgs"
            )


def stored_recipe(metadata: Mapping[str, str], key: str, path: str | os.PathLike[str]) -> Recipe:
    """The recipe under `key`, a resolved one, which follows no file.

    Raises CheckpointError, and RecipeError where its components are not those of this recipe.
    """
    tree = mapping_in(metadata, key, path)
    unresolved = [name for name in ("extends", "swap") if name in tree]
    if unresolved:
        why = f"the recipe in it has `{unresolved[0]}`; one that qgs writes is resolved"
        raise damaged(path, why)
    with reading(path, key):
        return resolve(tree)
