"""Go on from a scene that `qgs scene` wrote."""

from dataclasses import replace

from pydantic import BaseModel, PositiveFloat, PositiveInt, ValidationError

from qgs.reconstruction.scene_formats import load_ply
from qgs.types import Size
from qgs_photos.refine.initial import Start, chosen_initialisation, photos_world
from qgs_photos.refine.metric import Distance, in_metres
from qgs_photos.refine.options import Options
from qgs_photos.refine.scene_photos import ScenePhotos
from qgs_photos.viewing import in_own_world


class _Record(BaseModel):
    """Entries of metrics.json that are read, as `qgs_photos.refine.result` writes them."""

    command: str
    optimised: PositiveInt
    size: Size
    camera_centres: list[list[float]]
    factor: PositiveFloat = 1.0
    scale_by: Distance | None = None


def chosen_start(photos: ScenePhotos, options: Options) -> Start:
    """Return the start of the optimisation: from the scene `options.earlier`, if it is given.

    Surroundings of that scene are left out, since they are made anew. The options are returned with
    the photo size, the number of Gaussians and the measured distance of that scene, unless they
    have their own. Raises FileNotFoundError if the folder is no scene, ValueError for options of a
    model, for a file that is not as `qgs scene` writes it, for a scene that was made from other
    photos, other poses, or with other photos held out, and the errors of `chosen_initialisation`.
    """
    folder = options.earlier
    if folder is None:
        return chosen_initialisation(photos, options)
    if options.model or options.frames or options.scale:
        raise ValueError("--from replaces a model: leave out --model, --frames and --scale")
    file = folder / "scene.ply"
    if not file.is_file():
        raise FileNotFoundError(f"{file} does not exist: give a folder that `qgs scene` wrote")
    try:
        record = _Record.model_validate_json((folder / "metrics.json").read_bytes())
    except ValidationError as error:
        raise ValueError(
            f"{folder / 'metrics.json'} is not as this version of `qgs scene` writes it: make the "
            "scene again"
        ) from error
    if record.camera_centres != photos.centres:
        raise ValueError(
            f"{folder} was made from other photos than {photos.path}, with other poses, or with "
            f"other photos held out: give what its command names, {record.command}"
        )
    world = photos_world(photos)
    every = in_own_world(in_metres(world, record.factor), load_ply(file)).to(options.device)
    # surroundings come first
    gaussians = every[:, -record.optimised :]
    count = options.gaussians or gaussians.count
    size = options.size or record.size
    scale_by = options.scale_by or record.scale_by
    options = replace(options, size=size, gaussians=count, scale_by=scale_by)
    return world, gaussians, options
