"""Evaluation indices: which frames of which scenes are judged (pixelSplat's file format)."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, TypeAlias

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from qgs.data.paths import opened_path

FrameList: TypeAlias = Annotated[list[Annotated[int, Field(strict=True)]], Field(min_length=1)]


class IndexEntry(BaseModel):
    """Frames of one scene, as positions in its list of frames; what else a file says is ignored.

    context: the input frames, the first of which sets the model's frame. target: those judged.
    """

    model_config = ConfigDict(frozen=True)

    context: FrameList
    target: FrameList

    @property
    def both(self) -> tuple[int, ...]:
        """Frames that are context and target, in order; see `given_targets`."""
        return given_targets(self.context, self.target)


EvaluationIndex: TypeAlias = Mapping[str, IndexEntry | None]
"""Scene name to its frames; None for a scene that is listed but not judged."""

GIVEN = "frames as context and as target"
"""What `given_targets` are, in words; no score tells anything about them."""


def given_targets(inputs: Iterable[int], targets: Iterable[int]) -> tuple[int, ...]:
    """Frames, in order, that a model is given and judged on; the nearest input view is perfect."""
    return tuple(sorted(set(inputs) & set(targets)))


_FORM = '{"scene": null or {"context": [frames], "target": [frames]}}'
_ADAPTER = TypeAdapter(dict[str, IndexEntry | None])
_SHOWN = 5


def read_index(path: str) -> EvaluationIndex:
    """The index in the JSON file `path`, which may be an fsspec URL.

    Raises FileNotFoundError, and ValueError for a file of another form, for a scene that is
    written twice, and for an index without any scene to judge.
    """
    file = opened_path(path)
    if not file.is_file():
        raise FileNotFoundError(
            f"there is no evaluation index at {path}; evaluation.index is a JSON file of the form "
            f"{_FORM}, relative to the working directory"
        )
    try:
        index = _ADAPTER.validate_python(
            json.loads(file.read_text(encoding="utf-8"), object_pairs_hook=_without_repeats)
        )
    except ValidationError as error:
        raise ValueError(f"{path} is no evaluation index {_FORM}: {_told(error)}") from None
    except ValueError as error:
        raise ValueError(f"{path} is no evaluation index {_FORM}: {error}") from error
    if not any(index.values()):
        raise ValueError(f"the evaluation index {path} names no scene to judge")
    return index


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    times = Counter(key for key, _ in pairs)
    repeated = [key for key, count in times.items() if count > 1]
    if repeated:
        raise ValueError(f"written twice: {', '.join(repeated[:_SHOWN])}")
    return dict(pairs)


def _told(error: ValidationError) -> str:
    found = [f"{'.'.join(map(str, e['loc'])) or 'file'}: {e['msg']}" for e in error.errors()]
    more = len(found) - _SHOWN
    return "; ".join(found[:_SHOWN]) + (f"; and {more} more" if more > 0 else "")
