"""Which frames of a photo folder are reconstructed from, and which are compared with."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def choose_frames(
    total: int,
    inputs: int,
    frames: Sequence[int] | None = None,
    compare: Sequence[int] | None = None,
    novel: int = 6,
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Input frames and novel frames, from 0 to total - 1.

    frames: the inputs; None spreads `inputs` of them evenly over all frames. compare: the novel
    ones; None takes at most `novel`, evenly spread over the frames between the inputs.
    Raises ValueError for frames that do not exist, come twice, or are both input and novel.
    """
    chosen = _spread(range(total), inputs) if frames is None else tuple(frames)
    if not chosen or len(chosen) > total or (len(chosen) < inputs and frames is None):
        raise ValueError(f"{inputs} input views were asked for, but there are {total} photos")
    if compare is None:
        between = [f for f in range(min(chosen), max(chosen) + 1) if f not in chosen]
        compare = _spread(between, min(novel, len(between)))
    _check([*chosen, *compare], total)
    return chosen, tuple(compare)


def _spread(frames: Sequence[int], count: int) -> tuple[int, ...]:
    if count > len(frames):
        return ()
    places = (np.arange(count) + 0.5) * len(frames) / max(count, 1)
    return tuple(frames[int(place)] for place in places)


def _check(frames: Sequence[int], total: int) -> None:
    missing = [frame for frame in frames if not 0 <= frame < total]
    if missing:
        raise ValueError(f"frames {missing} do not exist; the photos are 0..{total - 1}")
    twice = sorted({frame for frame in frames if list(frames).count(frame) > 1})
    if twice:
        raise ValueError(f"frames {twice} are named twice; inputs and compared frames must differ")
