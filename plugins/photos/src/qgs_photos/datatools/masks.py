"""Masks that cannot be those of their photos, and photos that show nothing."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from qgs_photos.datatools.decoding import DecodedScene
from qgs_photos.datatools.epipolar import Pair
from qgs_photos.datatools.findings import Finding
from qgs_photos.datatools.suspects import above_in_all

_OBJECTS = 0.5  # masks that are whiter, as those of what moves, may be all white in some frames
_OPPOSITE = 0.5  # of matches with another frame contradict an inverted mask; of a sound one 0.1
_BORDER = 0.9  # white share of the border of masks that are white outside of an object
_STATIC = 0.5  # matches on black per area, by those on white: what moves matches less
_SURE = 3.2  # standard deviations between two counts of contradictions; sound masks have up to 3
_FIX = "invert the mask: white marks what is modelled"


def picture_findings(scene: DecodedScene) -> Iterator[Finding]:
    """Black photos, and masks that are all black or all white."""
    if black := [frame for frame, result in enumerate(scene.decoded) if result.black]:
        yield scene.finding(black, "the image is black", "replace it, or remove the frame")
    yield from _blank(scene, {frame: float(mask.mean()) for frame, mask in _masks(scene).items()})


def matched_findings(scene: DecodedScene, pairs: Sequence[Pair]) -> Iterator[Finding]:
    """Masks that matches contradict: inverted ones, and those of a neighbouring frame."""
    masks = {frame: mask for frame, mask in _masks(scene).items() if np.ptp(mask)}
    on = [(p.frames, values) for p in pairs if (values := _on(masks, p)) is not None]
    against = [(frames, float((one != two).mean())) for frames, (one, two) in on]
    if inverted := above_in_all(against, _OPPOSITE):
        reason = "the mask looks inverted: it is white where those of the other frames are black"
        yield scene.finding(inverted, reason, _FIX, "warning")
        masks = {frame: mask for frame, mask in masks.items() if frame not in inverted}
    own_on = [(p, values) for p in pairs if (values := _on(masks, p)) is not None]
    for step, which in ((-1, "next"), (1, "previous")):
        shifted = [(own, _on(masks, p, step), p.frames) for p, own in own_on]
        known = [(own, other, f) for own, other, f in shifted if other is not None]
        wrong, fewer = (
            sum(int((values[0] != values[1]).sum()) for values in group)
            for group in ([own for own, _, _ in known], [other for _, other, _ in known])
        )
        if wrong - fewer > _SURE * np.sqrt(wrong + fewer):
            frames = sorted({frame + step for _, _, two in known for frame in two})
            reason = f"the mask fits the {which} photo better than its own"
            fix = "check that masks and photos are in the same order"
            yield scene.finding(frames, reason, fix, "warning")
    ring = [np.concatenate([m[0], m[-1], m[:, 0], m[:, -1]]).mean() for m in masks.values()]
    if own_on and np.median(ring) > _BORDER:
        white = [float(masks[pair.frames[0]].mean()) for pair, _ in own_on]
        static = [
            (~values).mean() / (1 - share) / max(values.mean() / share, 1e-6)
            for share, (_, values) in zip(white, own_on, strict=True)
        ]
        if np.median(static) > _STATIC:
            reason = "the masks look inverted: they are black inside, on what stands still"
            yield scene.finding([*masks], reason, _FIX, "warning")


def _masks(scene: DecodedScene) -> dict[int, np.ndarray]:
    """Sound masks by frame, as `Decoded.mask`."""
    return {f: r.mask for f, r in enumerate(scene.decoded) if r.mask is not None}


def _on(masks: Mapping[int, np.ndarray], pair: Pair, step: int = 0) -> np.ndarray | None:
    """Whether masks are white at matches, (2, P); None for frames without one."""
    values: list[np.ndarray] = []
    for frame, points in zip(pair.frames, pair.matches, strict=True):
        mask = masks.get(frame + step)
        if mask is None:
            return None
        places = (points[:, ::-1] / pair.size * mask.shape).astype(int)
        rows, columns = np.minimum(places, np.array(mask.shape) - 1).T
        values.append(mask[rows, columns] > 0.5)
    return np.stack(values)


def _blank(scene: DecodedScene, white: Mapping[int, float]) -> Iterator[Finding]:
    """Masks that are all black or all white. white: share of the mask by frame."""
    usual = np.median([share for share in white.values() if 0 < share < 1] or [1.0])
    for value, color in ((0, "black"), (1, "white")):
        frames = [frame for frame, share in white.items() if share == value]
        every = len(frames) == len(white)
        if not frames or (value == 1 and not every and usual > _OBJECTS):
            continue
        reason = f"the mask is all {color}" + ("" if every else ", unlike those of other frames")
        fix = "make masks white on what is modelled, or list none"
        yield scene.finding(frames, reason, fix, "error" if every and not value else "warning")
