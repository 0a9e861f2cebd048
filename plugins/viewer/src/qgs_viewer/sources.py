"""Sources of scenes to look at: Gaussians alone, or a model that reconstructs any photos."""

from collections.abc import Sequence
from dataclasses import dataclass

from qgs.contracts import Scene, ViewsConfig
from qgs.data.samples import make_sample, own_world
from qgs.geometry.poses import relative_to, scaled
from qgs.model import QueryGaussianModel
from qgs.reconstruction.reconstruct import checked_window
from qgs.types import Cameras
from qgs_viewer.placement import Placement
from qgs_viewer.query_scene import QueryScene, explained


@dataclass
class Source:
    """Gaussians of no known model, whose inputs cannot be changed.

    notes: remarks for the user. frames: of the inputs at first. labels: of all frames; none where
    the inputs cannot be changed.
    """

    title: str
    notes: Sequence[str] = ()
    fixed: QueryScene | None = None
    frames: Sequence[int] = ()
    labels: Sequence[str] = ()

    def scene_of(self, frames: Sequence[int]) -> QueryScene:
        """Return the scene as made of these frames. Raises ValueError where they do not fit."""
        assert self.fixed is not None
        return self.fixed

    def cameras(self) -> Cameras | None:
        """Return cameras (F,) of all frames in the shown world; None without."""
        return None


class ModelSource(Source):
    """A model with a scene, of any number of its frames. The first frames' world is shown."""

    def __init__(
        self,
        model: QueryGaussianModel,
        scene: Scene,
        views: ViewsConfig,
        frames: Sequence[int],
        title: str,
        notes: Sequence[str] = (),
    ) -> None:
        labels = [scene.label(frame) for frame in range(len(scene))]
        super().__init__(title, notes, frames=tuple(frames), labels=labels)
        self.model = model
        self.scene = scene
        self.views = views
        self.world = own_world(scene, tuple(frames), views)

    def scene_of(self, frames: Sequence[int]) -> QueryScene:
        """Reconstruct from these frames, and place the result in the shown world."""
        if not frames:
            raise ValueError("a reconstruction needs an input photo: choose one at least")
        # refuses frames that are not there, twice or too many
        picked, _ = checked_window(len(self.scene), frames)
        world = own_world(self.scene, picked, self.views)
        device = next(self.model.parameters()).device
        inputs = make_sample(self.scene, picked, (), self.views, mirror=False).inputs.to(device)
        # other inputs have another world, while the user's view stays
        place = Placement.between(world, self.world)
        return explained(self.model, inputs, picked, place)

    def cameras(self) -> Cameras | None:
        """Return the cameras of all frames of the scene."""
        reference, scale = self.world
        own = self.scene.cameras
        c2w = scaled(relative_to(reference.double(), own.c2w.double()), scale.double())
        return Cameras(c2w, own.intrinsics.double(), own.size)
