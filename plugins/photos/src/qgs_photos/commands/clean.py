"""The command `qgs clean`."""

from pathlib import Path
from typing import Annotated

import typer

from qgs.cli.options import SceneName
from qgs.files import refuse_existing

# Shorter side of the photos, in pixels: in smaller ones, small Gaussians are shown by near photos
# alone.
_SIDE = 384

app = typer.Typer(help="Leave floaters out of a file of Gaussians.")


@app.command()
def clean(
    source: Annotated[Path, typer.Argument(metavar="IN", help="File of Gaussians.")],
    photos: Annotated[str, typer.Argument(help="Photos of the scene, with poses in its world.")],
    out: Annotated[
        Path,
        typer.Argument(
            metavar="OUT",
            help="New file; must not exist yet. A .glb gets the cameras of the photos.",
        ),
    ],
    scene_name: SceneName = None,
) -> None:
    """Leave out Gaussians near a camera that at most two photos show.

    Prints the mean PSNR of the photos before and after: it may fall a little, as floaters are what
    single photos need. `qgs scene` does this where held-out photos allow.
    """
    refuse_existing(out)

    import torch

    from qgs.data.samples import in_photos_world, views_in
    from qgs.reconstruction.scene_formats import load_ply, save_gaussians
    from qgs_photos.record import factor_of
    from qgs_photos.refine.evidence import evidence, quality
    from qgs_photos.refine.initial import photos_world
    from qgs_photos.refine.metric import in_metres
    from qgs_photos.refine.options import NONE, Options
    from qgs_photos.refine.scene_photos import ScenePhotos, sized
    from qgs_photos.viewing import in_own_world

    gaussians = load_ply(source)
    given = ScenePhotos(photos, Options(holdout=NONE, scene=scene_name))
    world = photos_world(given)
    finer = given.at(sized(given.small, _SIDE))
    views = views_in(world, finer, given.frames)
    measured = in_metres(world, factor_of(source))
    inside = in_own_world(measured, gaussians).to(torch.float32)
    found = evidence(inside, views)
    if not found.shown.any():
        raise ValueError(f"{photos} show nothing of {source}: their poses may be of another world")
    kept = gaussians[:, ~found.floating]
    names = map(given.small.frame_name, given.frames)
    save_gaussians(kept, out, in_photos_world(measured, views.cameras, names))
    before = quality(found.gaussians, views)
    after = quality(found.gaussians[:, ~found.floating], views)
    typer.echo(
        f"wrote {out}: {kept.count:,} of {gaussians.count:,} Gaussians; mean PSNR of the photos "
        f"{after:.2f} dB, before {before:.2f} dB"
    )
