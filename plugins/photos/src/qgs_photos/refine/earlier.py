"""Go on from a scene that `qgs scene` wrote."""

import json
from dataclasses import replace

from qgs.containers import map_tensors
from qgs.reconstruction.scene_formats import load_ply
from qgs_photos.refine.initial import Initialisation, chosen_initialisation, photos_world
from qgs_photos.refine.options import Options
from qgs_photos.refine.scene_photos import ScenePhotos
from qgs_photos.viewing import in_own_world


def chosen_start(photos: ScenePhotos, options: Options) -> tuple[Initialisation, Options]:
    """Return the start of the optimisation: from the scene `options.earlier`, if it is given.

    Surroundings of that scene are left out, since they are made anew. The options are returned with
    the photo size and the number of Gaussians of that scene, unless they have their own. Raises
    FileNotFoundError if the folder is no scene, ValueError if the scene was made from other photos,
    other poses, or with other photos held out, and the errors of `chosen_initialisation`.
    """
    folder = options.earlier
    if folder is None:
        return chosen_initialisation(photos, options), options
    file = folder / "scene.ply"
    if not file.is_file():
        raise FileNotFoundError(f"{file} does not exist: give a folder that `qgs scene` wrote")
    record = json.loads((folder / "metrics.json").read_bytes())
    if record.get("camera_centres") != photos.centres:
        raise ValueError(
            f"{folder} was made from other photos than {photos.path}, with other poses, or with "
            f"other photos held out: give what its command names, {record['command']}"
        )
    world = photos_world(photos)
    every = in_own_world(world, load_ply(file)).to(options.device)
    # surroundings come first
    gaussians = map_tensors(lambda part: part[:, -record["optimised"] :], every)
    count = options.gaussians or gaussians.count
    size = options.size or tuple(record["size"])
    start = Initialisation(None, world, gaussians)
    return start, replace(options, size=size, gaussians=count)
