"""Small, deterministic inputs for a component of each slot."""

import math
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.containers import map_tensors
from qgs.contracts import MEMORY_FIELDS, Decode, Fields, FieldSpec, ModelDims, Render
from qgs.geometry.rays import patch_rays, plucker_rays
from qgs.geometry.transforms import to_camera
from qgs.precision import at_least_float32, full_precision
from qgs.types import Cameras, Gaussians, ImageMemory, LayerPrediction, QueryState, Rendering, Views
from qgs_dev.case import Case

# Arguments of a component's forward pass by name, in order.
Inputs = dict[str, Any]

# Side in pixels of a patch in the image memory for decoder components.
PATCH = 8


def data_file(name: str) -> dict[str, Any]:
    """Read a TOML file of this package."""
    return tomllib.loads(Path(__file__).with_name(name).read_text(encoding="utf-8"))


# Facts about each slot; slots.toml explains them.
FACTS: dict[str, dict[str, Any]] = data_file("slots.toml")

# Slots whose components return a state and an image memory.
WITH_MEMORY = ("layer", "feedback")

# Arguments whose second dimension counts queries.
QUERY_INPUTS = ("state", "features", "offsets")


class Sizes(NamedTuple):
    """Sizes of inputs: B scenes, N queries, V views, K Gaussians per query, and images (H, W).

    image: None takes the image size of the case.
    """

    batch: int = 2
    queries: int = 6
    views: int = 2
    gaussians: int = 2
    image: tuple[int, int] | None = None


USUAL = Sizes()


def many(case: Case) -> Sizes:
    """Return sizes with more than 128 queries, Gaussians and tokens.

    Such sizes reveal errors of components that work in chunks or windows of up to 128.
    """
    image = (64, 96) if case.slot == "cross_attention" else None
    return Sizes(queries=200, views=3, gaussians=1, image=image)


def inputs_of(case: Case, sizes: Sizes = USUAL, seed: int = 0) -> Inputs:
    """Return random arguments for the component of `case`, by argument name."""
    maker = Maker(case, sizes, seed)
    return {name: getattr(maker, name)() for name in FACTS[case.slot]["arguments"]}


def required_fields(case: Case) -> Fields:
    """Return the fields of the query state that the component requires."""
    elsewhere = ("memory.", "rendering.", "gaussians.")
    return {name: spec for name, spec in case.reads.items() if not name.startswith(elsewhere)}


def required_places(case: Case) -> set[str]:
    """Return the names of the required state fields that hold points in the world frame."""
    return {name for name, spec in required_fields(case).items() if is_place(spec)}


def memory_width(case: Case) -> int:
    """Return the width of memory features: as the component requires, or else the model's width."""
    features = "memory.features"
    return sizes_of(case.reads.get(features, MEMORY_FIELDS[features]), case.dims)[0]


class Maker:
    """Generator of random inputs of the given sizes.

    axes: size of each dimension, by its letter in slots.toml, such as N for queries.
    """

    def __init__(self, case: Case, sizes: Sizes = USUAL, seed: int = 0) -> None:
        height, width = sizes.image or case.size
        self.case = case
        self.generator = torch.Generator().manual_seed(seed)
        self.axes: dict[str, Any] = {
            "B": sizes.batch,
            "N": sizes.queries,
            "V": sizes.views,
            "K": sizes.gaussians,
            "G": sizes.queries * sizes.gaussians,
            "D": case.dims.width,
            "h": case.dims.heads,
            "H": height,
            "W": width,
        }

    def shape(self, axes: str) -> list[int]:
        """Return the shape for dimensions such as "BN3": letters of slots.toml, or digits."""
        return [self.axes[axis] if axis in self.axes else int(axis) for axis in axes]

    def normal(self, axes: str, *more: int) -> Tensor:
        """Return normally distributed random numbers.

        axes: letters of leading dimensions, such as "BN". more: sizes of further dimensions.
        """
        shape = [*self.shape(axes), *more]
        return torch.randn(shape, generator=self.generator).to(self.case.device)

    def uniform(self, low: float, high: float, axes: str) -> Tensor:
        """Return uniformly distributed random numbers between `low` and `high`.

        axes: letters or sizes of dimensions, such as "BV3HW".
        """
        numbers = torch.rand(self.shape(axes), generator=self.generator)
        return (low + (high - low) * numbers).to(self.case.device)

    def in_front(self, points: Tensor) -> Tensor:
        """Scale and shift normally distributed points (..., 3) to lie in front of the cameras."""
        return 0.4 * points + torch.tensor([0.0, 0.0, 1.5]).to(points)

    def field(self, spec: FieldSpec) -> Tensor:
        """Return a random state field. Points in the world frame are in front of the cameras."""
        values = self.normal("BN", *sizes_of(spec, self.case.dims))
        # One check alone is about points behind the cameras.
        if is_place(spec):
            values = self.in_front(values)
        return (values if spec.dtype.is_floating_point else values > 0).to(spec.dtype)

    def state(self) -> QueryState:
        """Return a random query state: features, and the fields that the component requires."""
        required = required_fields(self.case)
        return QueryState(self.features(), {n: self.field(spec) for n, spec in required.items()})

    def features(self) -> Tensor:
        """Return random features (B, N, D)."""
        return self.normal("BND")

    def offsets(self) -> Tensor:
        """Return random offsets (B, N, K, 3)."""
        return self.normal("BNK3")

    def cameras(self, multiple: int = 1) -> Cameras:
        """Return cameras side by side that look along z and slightly inwards.

        multiple: number to whose multiples both sides of the images are rounded up.
        """
        height, width = (-(-side // multiple) * multiple for side in self.shape("HW"))
        scene = torch.arange(self.axes["B"])[:, None]
        view = torch.arange(self.axes["V"])
        # The views overlap. No two cameras are equal, because that would hide a mix-up.
        angle = -0.06 * view - 0.02 * scene
        c2w = torch.eye(4).repeat(*angle.shape, 1, 1)
        c2w[..., 0, 0] = c2w[..., 2, 2] = angle.cos()
        c2w[..., 0, 2] = angle.sin()
        c2w[..., 2, 0] = -angle.sin()
        c2w[..., 0, 3] = 0.2 * view
        c2w[..., 1, 3] = 0.05 * scene
        focal = 0.9 * max(height, width)
        lens = torch.tensor([focal, focal, width / 2, height / 2]).repeat(*angle.shape, 1)
        return Cameras(c2w, lens, (height, width)).to(self.case.device)

    def views(self) -> Views:
        """Return random noise images with cameras, and with times if the component embeds times."""
        views = Views(self.uniform(0, 1, "BV3HW"), self.cameras())
        if not getattr(self.case.config, "time_channels", 0):
            return views
        times = self.uniform(0, 1, "BV")
        return views.replace(times=times, target_time=times[:, :1])

    def memory(self) -> ImageMemory:
        """Return a random `ImageMemory` with one camera ray per patch of PATCH x PATCH pixels."""
        # The image size need not be a multiple of PATCH; rays exist for whole patches only.
        whole = self.cameras(PATCH)
        grid = (self.axes["V"], whole.size[0] // PATCH, whole.size[1] // PATCH)
        dims = self.case.dims
        per_head = (math.prod(grid), dims.width // dims.heads)
        return ImageMemory(
            keys=self.normal("Bh", *per_head),
            values=self.normal("Bh", *per_head),
            features=self.normal("B", math.prod(grid), memory_width(self.case)),
            patch_rays=patch_rays(plucker_rays(whole), PATCH),
            grid=grid,
        )

    def gaussians(self) -> Gaussians:
        """Return random Gaussians in front of the cameras; `gives` chooses optional tensors."""
        return Gaussians(
            means=self.in_front(self.normal("BG3")),
            scales=self.uniform(0.05, 0.3, "BG3"),
            quats=F.normalize(self.normal("BG4"), dim=-1),
            opacities=self.uniform(0.2, 0.9, "BG"),
            colors=self.uniform(0, 1, "BG3"),
            sh=0.1 * self.normal("BG83") if self.gives("sh") else None,
            features=self.uniform(0, 1, "BG4") if self.gives("features") else None,
        )

    def gives(self, name: str) -> bool:
        """Return True if Gaussians should have the optional tensor `name`, such as "sh".

        Renderers get all optional tensors; other components get only those that they require.
        """
        return self.case.slot == "renderer" or f"gaussians.{name}" in self.case.reads

    def prediction(self) -> LayerPrediction:
        """Return a random prediction of a layer: Gaussians and a query state."""
        return LayerPrediction(self.gaussians(), self.state())

    def rendering(self) -> Rendering:
        """Return random renderings of all views, or of no view if the loss needs no renderings."""
        rendering = self.all_views()
        unseen = getattr(self.case.component, "renderings", "") == "none"
        return map_tensors(lambda x: x[:, :0], rendering) if unseen else rendering

    def all_views(self) -> Rendering:
        """Return random numbers as renderings of all views."""
        return Rendering(
            rgb=self.uniform(0, 1, "BV3HW"),
            alpha=self.uniform(0, 1, "BV1HW"),
            depth=self.uniform(1, 2, "BV1HW"),
            features=self.uniform(0, 1, "BV4HW") if self.gives("features") else None,
        )

    def decode(self) -> Decode:
        """Return a function that decodes K round Gaussians of each query from its features."""
        weights_DX = self.normal("D", 7 * self.axes["K"]) / math.sqrt(self.axes["D"])

        def decoded(state: QueryState) -> Gaussians:
            raw_BNX = at_least_float32(state.features) @ weights_DX.to(state.features)
            raw_BGC = raw_BNX.unflatten(-1, (-1, 7)).flatten(1, 2)
            means, opacities, colors = raw_BGC.split((3, 1, 3), -1)
            quats = F.pad(torch.ones_like(opacities), (0, 3))
            opacities = opacities[..., 0].sigmoid()
            return Gaussians(self.in_front(means), means.sigmoid(), quats, opacities, colors)

        return decoded

    def render(self) -> Render:
        """Return a stand-in for a renderer, which runs on any device and can be compiled."""
        return plain

    def target(self) -> Views:
        """Return random images, cameras and masks; and depth maps for a loss that reads them."""
        views = self.views().replace(masks=self.uniform(0, 1, "BV1HW").round())
        if not getattr(self.case.component, "reads_depths", False):
            return views
        return views.replace(depths=self.uniform(1, 2, "BV1HW"))

    # Each call draws other images: the inputs of a prediction are not its target.
    inputs = target


@full_precision
def plain(gaussians: Gaussians, cameras: Cameras) -> Rendering:
    """Render one colour, a mean in which Gaussians far in front of the camera weigh more."""
    depths_BVG = to_camera(gaussians.means, cameras)[..., 2]
    weights_BVG = depths_BVG.sigmoid() * gaussians.opacities[:, None]
    # Not a matrix product, which a check would take for a learned layer.
    rgb_BVC = (weights_BVG[..., None] * gaussians.colors[:, None]).sum(2)
    pixels_BVCHW = rgb_BVC[..., None, None].expand(-1, -1, -1, *cameras.size)
    return Rendering(pixels_BVCHW, pixels_BVCHW[:, :, :1], pixels_BVCHW[:, :, :1])


def sizes_of(spec: FieldSpec, dims: ModelDims) -> list[int]:
    """Return the shape of a field without the axes of scenes and of queries or tokens.

    dims: sizes of the model. A size "4*D" is four times the model's width. A name other
    than D, h and D/h counts as 4.
    """
    named = {"D": dims.width, "h": dims.heads, "D/h": dims.width // dims.heads}
    factors = [str(size).split("*") for size in spec.shape]
    return [
        math.prod(int(part) if part.isdigit() else named.get(part, 4) for part in parts)
        for parts in factors
    ]


def is_place(spec: FieldSpec) -> bool:
    """Return True if a field holds points in the world frame."""
    return spec.shape == (3,) and spec.frame == "world" and spec.dtype.is_floating_point
