"""Which frames of a photo folder are reconstructed from, and which are compared with."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def choose_frames(
    total: int,
    inputs: int,
    span: int,
    frames: Sequence[int] | None = None,
    compare: Sequence[int] | None = None,
    novel: int = 6,
    held_out: Sequence[int] = (),
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Input frames and novel frames, from 0 to total - 1.

    frames: the inputs; None spreads `inputs` of them over `span` frames in the middle of all, both
    ends included, or over all when there are fewer. compare: the novel ones; None takes at most
    `novel`, evenly spread over the frames between the inputs. held_out: frames that the model was
    not trained on, of a folder that it was trained on; the inputs are then chosen from the others,
    and compared are those between the inputs, where there are any.
    Raises ValueError for frames that do not exist, come twice, or are both input and novel.
    """
    usable = [frame for frame in range(total) if frame not in held_out]
    chosen = _middle(usable, inputs, max(span, inputs)) if frames is None else tuple(frames)
    if compare is None:
        between = [f for f in range(min(chosen), max(chosen) + 1) if f not in chosen]
        between = [f for f in between if f in held_out] or between
        compare = _evenly(between, min(novel, len(between)))
    _check([*chosen, *compare], total)
    return chosen, tuple(compare)


def _middle(frames: Sequence[int], count: int, span: int) -> tuple[int, ...]:
    if count > len(frames):
        raise ValueError(f"{count} input views were asked for, but there are {len(frames)} photos")
    span = min(span, len(frames))
    first = (len(frames) - span) // 2
    return _evenly(frames[first : first + span], count)


def _evenly(frames: Sequence[int], count: int) -> tuple[int, ...]:
    """`count` of `frames`, the first and the last among them; one alone is the middle one."""
    last = len(frames) - 1
    places = np.linspace(0, last, count).round() if count > 1 else np.full(count, last // 2)
    return tuple(frames[int(place)] for place in places)


def _check(frames: Sequence[int], total: int) -> None:
    missing = [frame for frame in frames if not 0 <= frame < total]
    if missing:
        raise ValueError(f"frames {missing} do not exist; the photos are 0..{total - 1}")
    twice = sorted({frame for frame in frames if list(frames).count(frame) > 1})
    if twice:
        raise ValueError(f"frames {twice} are named twice; inputs and compared frames must differ")
