"""Verdict on a reconstruction: what its inputs see of scored views, and how close that is."""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from qgs.contracts import Column
from qgs.data.samples import Sample
from qgs.geometry.transforms import depths_in_view
from qgs.metrics.baselines import nearest_input
from qgs.types import Rendering
from qgs.wording import listed
from qgs_viewer.placement import on_photo, patch_centers

COVERAGE = Column("coverage", "higher", digits=0, unit="%")
WHOLE = "whole"
# Alpha above which a pixel shows Gaussians rather than background.
SOLID = 0.5
# Least PSNR in dB that a word stands for.
QUALITY = {"Sharp": 25.0, "Soft": 20.0, "Blurred": 0.0}
UNSEEN = "Grey or guessed where no input looks"
WRONG = "No better than a copy of the nearest photo"
NAMED = 3
"""Largest number of places that a sentence names."""


class Part(NamedTuple):
    """A part of a scored view, and how well it is known.

    coverage: share of its pixels that inputs see. psnr, copied: PSNR in dB in these pixels, of the
    render and of the nearest input; NaN if the inputs see no pixel.
    """

    coverage: float
    psnr: float
    copied: float

    @property
    def doubt(self) -> str:
        """Reason not to trust the part; "" if there is none (rules 2 and 3 of `verdict`)."""
        if self.coverage < 0.5:
            return UNSEEN
        return "" if self.psnr > self.copied else WRONG


ScoredView = tuple[str, Mapping[str, Part]]
"""Name of a scored view, and its parts by name. The part WHOLE is the whole view."""


def scored_views(sample: Sample, rendering: Rendering) -> Iterator[ScoredView]:
    """Yield the T target views of a sample, of which `rendering` is (1, T).

    Their parts are the whole, thirds of the width, and the upper and the lower third.
    """
    rendering = rendering.to("cpu")
    targets = sample.targets
    size = targets.cameras.size
    centers = patch_centers((1, *size), size)
    depths = rendering.depth[0].flatten(1)[..., None]
    points = on_photo(targets.cameras[0], centers, depths).flatten(0, 1)
    unseen = depths_in_view(points, sample.inputs.cameras).isnan().all(0)
    alpha = rendering.alpha[0, :, 0]
    # an input sees the point at the rendered depth; pixels of background do not count
    seen = ~unseen.view_as(alpha) & (alpha > SOLID)
    images = (rendering.rgb.clamp(0, 1), nearest_input(sample.inputs, targets.cameras))
    errors = [(image - targets.images)[0].square().mean(1) for image in images]
    for view, frame in enumerate(sample.target_frames):
        maps = torch.stack([each[view].float() for each in (seen, *errors)])
        left, middle, right = maps.tensor_split(3, -1)
        top, _, bottom = maps.tensor_split(3, -2)
        thirds = {"left": left, "middle": middle, "right": right, "top": top, "bottom": bottom}
        parts = {name: _part(*part) for name, part in {WHOLE: maps, **thirds}.items()}
        photo = Path(sample.names.get(frame, "")).name
        yield photo or f"view {frame} of {sample.scene}", parts


def _part(seen: Tensor, *errors: Tensor) -> Part:
    """Return a part, of maps (H, W): which pixels are seen, and the squared errors of images."""
    scores = [-10 * error[seen > 0].mean().log10() for error in errors]
    return Part(float(seen.mean()), *map(float, scores))


def means(views: Sequence[ScoredView]) -> Part:
    """Return the means over whole views. Views without any covered pixel have no PSNR."""
    whole = torch.tensor([parts[WHOLE] for _, parts in views])
    return Part(*whole.nanmean(0).tolist())


def verdict(views: Sequence[ScoredView]) -> str:
    """Return sentences that say how far to trust the renders of a model, by these rules.

    1. Renders are sharp, soft or blurred by their mean PSNR where inputs look, see QUALITY. If that
       of the nearest photo is as high, they are wrong, and no part is to be trusted.
    2. A third of a view is grey or guessed if the inputs see less than half of it.
    3. A third is wrong if inputs see half of it, but the nearest photo is as close to the truth.
    4. A third, such as the left one, is not to be trusted if 2 or 3 holds in half of the views.
    5. Scored inputs tell nothing of other views.
    """
    coverage, quality, copied = means(views)
    if not coverage:
        return "The inputs see nothing of the scored views. Do not trust any part."
    if math.isinf(copied):
        return (
            f"The inputs are rendered with {quality:.1f} dB. No other photo shows how good new "
            "views are: add one from between the inputs."
        )
    word = next((word for word, least in QUALITY.items() if quality >= least), "Wrong")
    if quality <= copied:
        word = "Wrong"
    place = f"where the inputs look, at {100 * coverage:.0f} % of the scored views"
    numbers = f"({quality:.1f} dB there, a copy of the nearest photo {copied:.1f} dB)"
    sentences = [f"{word} {place} {numbers}."]
    doubtful = Counter[str]()
    places: dict[str, list[str]] = {UNSEEN: [], WRONG: []}
    for view, parts in views:
        for name, part in parts.items():
            if name != WHOLE and part.doubt:
                doubtful[name] += 1
                places[part.doubt].append(f"the {name} third of {view}")
    sentences += [f"{doubt}: {listed(found, NAMED)}." for doubt, found in places.items() if found]
    worst = [name for name, count in doubtful.items() if 2 * count >= len(views)]
    if quality <= copied:
        sentences.append("Do not trust any part.")
    elif worst:
        sentences.append(f"Do not trust the {listed(worst, between=' or the ')} third.")
    return " ".join(sentences)
