"""Masks that cannot be those of their photos, and photos that show nothing."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from qgs_photos.datatools.decoding import DecodedScene
from qgs_photos.datatools.epipolar import Pair, frames_above
from qgs_photos.datatools.findings import Finding, Severity

# Masks that are whiter, as those of what moves, may be all white in some frames.
_OBJECTS = 0.5
# Of matches with another frame contradict an inverted mask; of a sound one 0.1.
_OPPOSITE = 0.5
# White share of the border of masks that are white outside of an object.
_BORDER = 0.9
# Matches on black per area, by those on white: what moves matches less.
_STATIC = 0.5
# Standard deviations between two counts of contradictions; sound masks have up to 3.
_SURE = 3.2
_FIX = "invert the mask: white marks what is modelled"


def picture_findings(scene: DecodedScene) -> Iterator[Finding]:
    """Yield black photos, and masks that are all black or all white."""
    if black := [frame for frame, result in enumerate(scene.decoded) if result.black]:
        yield scene.finding(black, "the image is black", "replace it, or remove the frame")
    shares = {frame: float(mask.mean()) for frame, mask in _masks(scene).items()}
    # masks of objects leave most out, those of what moves little
    usual = np.median([share for share in shares.values() if 0 < share < 1] or [1.0])
    for value, color in ((0, "black"), (1, "white")):
        frames = [frame for frame, share in shares.items() if share == value]
        every = len(frames) == len(shares)
        if not frames or (value == 1 and not every and usual > _OBJECTS):
            continue
        others = "" if every else ", unlike those of other frames"
        severity: Severity = "error" if every and value == 0 else "warning"
        fix = "make masks white on what is modelled, or list none"
        yield scene.finding(frames, f"the mask is all {color}{others}", fix, severity)


def matched_findings(scene: DecodedScene, pairs: Sequence[Pair]) -> Iterator[Finding]:
    """Yield masks that matches contradict: inverted ones, and those of a neighbouring frame."""
    masks = {frame: mask for frame, mask in _masks(scene).items() if np.ptp(mask)}
    against = [
        (pair.frames, float((own[0] != own[1]).mean())) for pair, own in _at_matches(masks, pairs)
    ]
    if inverted := sorted(frames_above(against, _OPPOSITE)):
        reason = "the mask looks inverted: it is white where those of the other frames are black"
        yield scene.finding(inverted, reason, _FIX, "warning")
        masks = {frame: mask for frame, mask in masks.items() if frame not in inverted}
    own = _at_matches(masks, pairs)
    for step, which in ((-1, "next"), (1, "previous")):
        if frames := _fit_better(masks, own, step):
            reason = f"the mask fits the {which} photo better than its own"
            fix = "check that masks and photos are in the same order"
            yield scene.finding(frames, reason, fix, "warning")
    if own and _leave_out_what_stands(masks, own):
        reason = "the masks look inverted: they are black inside, on what stands still"
        yield scene.finding([*masks], reason, _FIX, "warning")


def _masks(scene: DecodedScene) -> dict[int, np.ndarray]:
    """Return sound masks by frame, see `Decoded.mask`."""
    return {f: result.mask for f, result in enumerate(scene.decoded) if result.mask is not None}


def _at_matches(
    masks: Mapping[int, np.ndarray], pairs: Sequence[Pair], step: int = 0
) -> list[tuple[Pair, np.ndarray]]:
    """Return pairs with masks, and whether these are white at the matches, (2, P).

    step: takes the masks of frames that many places on.
    """
    found = list[tuple[Pair, np.ndarray]]()
    for pair in pairs:
        chosen = [masks.get(frame + step) for frame in pair.frames]
        values = [
            _white(mask, points / pair.size[::-1])
            for mask, points in zip(chosen, pair.matches, strict=True)
            if mask is not None
        ]
        if len(values) == 2:
            found.append((pair, np.stack(values)))
    return found


def _white(mask: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return whether a mask (H, W) is white at points (P, 2), in parts of its width and height."""
    places = (points[:, ::-1] * mask.shape).astype(int)
    rows, columns = np.minimum(places, np.array(mask.shape) - 1).T
    return mask[rows, columns] > 0.5


def _fit_better(
    masks: Mapping[int, np.ndarray], own: Sequence[tuple[Pair, np.ndarray]], step: int
) -> list[int]:
    """Return the frames of masks that fit photos `step` before them better than their own."""
    others = _at_matches(masks, [pair for pair, _ in own], step)
    known = {pair.frames for pair, _ in others}
    wrong = sum(_contradictions(values) for pair, values in own if pair.frames in known)
    fewer = sum(_contradictions(values) for _, values in others)
    if wrong - fewer <= _SURE * np.sqrt(wrong + fewer):
        return []
    return sorted({frame + step for frames in known for frame in frames})


def _contradictions(values: np.ndarray) -> int:
    return int((values[0] != values[1]).sum())


def _leave_out_what_stands(
    masks: Mapping[int, np.ndarray], own: Sequence[tuple[Pair, np.ndarray]]
) -> bool:
    """Return whether masks are white around what matches as well as the rest."""
    ring = [np.concatenate([m[0], m[-1], m[:, 0], m[:, -1]]).mean() for m in masks.values()]
    if np.median(ring) <= _BORDER:
        return False
    ratios = list[float]()
    for pair, values in own:
        share = float(masks[pair.frames[0]].mean())
        # matches per area: what stands still matches wherever it is
        on_white = values.mean() / share
        on_black = (~values).mean() / (1 - share)
        ratios.append(on_black / max(on_white, 1e-6))
    return bool(np.median(ratios) > _STATIC)
