"""Open the photos of `qgs scene`, and choose held-out photos."""

from qgs.contracts import Frames, Scene
from qgs.data.view_samplers import held_out_frames
from qgs.reconstruction.scenes import Size, photo_scene
from qgs_photos.refine.options import NONE, Options

SMALL = 128
"""Shorter side in pixels of photos with which a step is timed; smaller ones look blurred."""


class ScenePhotos:
    """The photos of `qgs scene`, at any size.

    path: folder, URL or video. small: the scene with small photos. held_out: indices of photos that
    are held out for scores. frames: indices of the other photos, for the optimisation.
    """

    def __init__(self, path: str, options: Options) -> None:
        self.path = path
        self.name = options.scene
        found = self.at(None)
        self.small = self.at(sized(found, SMALL))
        self.held_out = judged_frames(found, options.holdout)
        self.frames = tuple(frame for frame in range(len(found)) if frame not in self.held_out)
        # a model's inputs are chosen among the others
        self.small.held_out = self.held_out

    @property
    def centres(self) -> list[list[float]]:
        """Camera positions of the photos for the optimisation, in float32."""
        return self.small.cameras.c2w[list(self.frames), :3, 3].float().tolist()

    def at(self, size: Size | None) -> Scene:
        """Return the scene with photos of `size` (H, W); None takes the stored size."""
        return photo_scene(self.path, size, self.name)


def judged_frames(scene: Scene, holdout: str) -> Frames:
    """Return the indices of the held-out photos, which are scored and never optimised on.

    holdout: NONE holds out no photo. A number N of at least 2 holds out the photos that the data
    set lists as held out, or every Nth if it lists none. Raises ValueError for another text.
    """
    if holdout == NONE:
        return ()
    if not holdout.isdecimal() or int(holdout) < 2:
        raise ValueError(
            "--holdout must be none, or a number N of at least 2 to hold out every Nth photo; got "
            f"{holdout!r}"
        )
    return tuple(scene.held_out) or held_out_frames(len(scene), int(holdout))


def sized(scene: Scene, side: int) -> Size:
    """Return (H, W) of uncropped photos whose shorter side has `side` pixels.

    The result is never larger than the stored photos.
    """
    stored = scene.stored_size(0) or scene.cameras.size
    # enlarged photos show nothing more and take longer
    factor = min(side / min(stored), 1.0)
    height, width = (max(round(factor * length), 1) for length in stored)
    return height, width
