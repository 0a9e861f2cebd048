"""Draws a look into a scene of viser: Gaussians, photos, anchors, a query and what it reads."""

from typing import Any

import numpy as np
import torch
import trimesh
import viser
from torch import Tensor
from viser.transforms import SO3

from qgs.drawing.images import enlarged, rgb_picture
from qgs.geometry.transforms import to_camera, to_pixels
from qgs.types import Cameras
from qgs_viewer.choice import Choice, anchor_colors, faded, ink, painted, query_color
from qgs_viewer.look import Look
from qgs_viewer.placement import corners, on_photo

PHOTO_SIDE = 256  # pixels on the longer side of photos: small ones are enlarged, large reduced
FRUSTUM = 0.12  # depth of a camera's frustum, per distance from the input cameras to the scene
WIDER = (0.25, 0.6)  # shares of the most that is read from which lines are broader
FAINTEST = 0.08  # strength of the colour of what is hardly read
SOLID = 0.1  # opacity of the Gaussians that count for the size of a scene
_VIEWS = "/views"
_EDGES = ((0, 1), (1, 2), (2, 3), (3, 0))


class Stage:
    """What is in a scene of viser. Everything drawn has one name and replaces what had it.

    photo_depth: of photos before their cameras. anchor_radius: viser's `point_size`, half a width.
    """

    def __init__(self, scene: viser.SceneApi) -> None:
        self.scene = scene
        self.photo_depth, self.anchor_radius = FRUSTUM, 0.01
        self._gaussians: viser.GaussianSplatHandle | None = None
        self._painted: tuple[Look, Choice] | None = None

    def put(
        self, look: Look, choice: Choice, every: Cameras | None = None, unit: float | None = None
    ) -> None:
        """Draw a new look. every: cameras of all frames, drawn thin.

        unit: length that sizes photos and anchors, by default `distance_to` the look.
        """
        unit = unit or distance_to(look)
        self.photo_depth, self.anchor_radius = FRUSTUM * unit, 0.01 * unit
        plain = np.full((8, 8, 3), 255.0) * look.background
        self.scene.set_background_image(plain.round().astype(np.uint8), "png")
        self._draw_photos(look, every)
        self.update(look, choice)

    def update(self, look: Look, choice: Choice) -> None:
        """Draw what a choice changes."""
        self._draw_gaussians(look, choice)
        if (views := self.scene.get_handle_by_name(_VIEWS)) is not None:
            views.visible = choice.photos
        self._draw_anchors(look, choice)
        self._draw_support(look, choice)
        self._draw_path(look, choice)
        self._draw_reading(look, choice)

    def _draw_gaussians(self, look: Look, choice: Choice) -> None:
        paint = Choice(choice.by_query, choice.query, others=choice.others)
        if self._painted is not None and self._painted[0] is look and self._painted[1] == paint:
            return
        shown = painted(look, choice)
        factor = shown.magnification
        sizes = shown.centers * factor, shown.covariances * factor**2
        parts = *sizes, shown.colors, shown.opacities
        if self._gaussians is None:
            self._gaussians = self.scene.add_gaussian_splats("/gaussians", *parts, scale=1 / factor)
        else:
            self._gaussians.set_gaussians(*parts)
            self._gaussians.scale = 1 / factor
        self._painted = look, paint

    def _draw_photos(self, look: Look, every: Cameras | None) -> None:
        self.scene.remove_by_name(_VIEWS)
        if look.views is None:
            return
        self.scene.add_frame(_VIEWS, show_axes=False)
        place, cameras = look.placement, look.views.cameras[0]
        depth = self.photo_depth / place.scale
        ends = place.points(on_photo(cameras, corners(cameras.size), depth))
        eyes = place.points(cameras.c2w[:, :3, 3])
        self._lines(f"{_VIEWS}/inputs", frustum_lines(eyes, ends), ink(look), 2.0)
        for view, image in enumerate(look.views.images[0]):
            corner, right, _, left = ends[view]
            turned = place.rotation @ cameras.c2w[view, :3, :3].cpu().double()
            picture = rgb_picture(image)
            if max(picture.shape) != PHOTO_SIDE:
                picture = enlarged(picture, PHOTO_SIDE)
            self.scene.add_image(
                f"{_VIEWS}/{view}", picture,
                float((right - corner).norm()), float((left - corner).norm()),
                wxyz=SO3.from_matrix(turned.numpy()).wxyz, position=ends[view].mean(0).numpy(),
            )  # fmt: skip
        if every is not None:
            ends = on_photo(every, corners(every.size), self.photo_depth / 2)
            lines = frustum_lines(every.c2w[:, :3, 3], ends)
            self._lines(f"{_VIEWS}/others", lines, faded(ink(look), 0.6, look), 1.0)

    def _draw_anchors(self, look: Look, choice: Choice) -> None:
        found = look.support(choice.layer)
        if found is None or not choice.anchors:
            self.scene.remove_by_name("/anchors")
            return
        numbers, colors = anchor_colors(look, choice)
        self.scene.add_point_cloud(
            "/anchors", found.centers[0].float().numpy()[numbers], colors,
            point_size=self.anchor_radius, point_shape="circle", precision="float32",
        )  # fmt: skip

    def _draw_support(self, look: Look, choice: Choice) -> None:
        found = look.support(choice.layer)
        if found is None or choice.query is None:
            self.scene.remove_by_name("/support")
            return
        ball = trimesh.creation.icosphere(subdivisions=2)
        points = torch.from_numpy(np.array(ball.vertices)) @ found.axes[0, choice.query].mT
        points = points + found.centers[0, choice.query]
        self.scene.add_mesh_simple(
            "/support", points.float().numpy(), np.array(ball.faces),
            color=query_color(choice.query), wireframe=True, opacity=0.5,
            cast_shadow=False, receive_shadow=False,
        )  # fmt: skip

    def _draw_path(self, look: Look, choice: Choice) -> None:
        """The way of the anchor from its start to the chosen layer."""
        found = [look.support(layer) for layer in range(choice.layer + 1)]
        if choice.query is None or len(found) < 2 or found[0] is None:
            self.scene.remove_by_name("/path")
            return
        points = torch.stack([s.centers[0, choice.query] for s in found if s is not None])
        self._lines("/path", torch.stack([points[:-1], points[1:]], 1), ink(look), 3.0)

    def _draw_reading(self, look: Look, choice: Choice) -> None:
        """Lines from where the query was when it read to the patches that it read most.

        Colour and width grow with the share of the most that is read. A square of half its width
        marks each patch, a little nearer to the camera than the photo, which would hide it.
        """
        reading = None
        if choice.query is not None and choice.layer and choice.patches:
            depth = 0.97 * self.photo_depth
            reading = look.strongest(choice.query, choice.layer, choice.patches, depth)
        if reading is None or choice.query is None:
            self.scene.remove_by_name("/reading")
            self.scene.remove_by_name("/patches")
            return
        hub = look.hub(choice.query, choice.layer - 1).expand_as(reading.points)
        lines = torch.stack([hub, reading.points], 1)
        shares = (reading.shares / reading.shares.max().clamp_min(1e-30))[:, None].numpy()
        colors = faded(query_color(choice.query), FAINTEST + (1 - FAINTEST) * shares, look)
        self.scene.add_frame("/reading", show_axes=False)
        for width, among in enumerate(np.digitize(shares[:, 0], WIDER) == np.arange(3)[:, None]):
            name, pairs = f"/reading/{width}", colors[among, None].repeat(2, 1)
            self.scene.remove_by_name(name)
            if among.any():
                self._lines(name, lines[torch.from_numpy(among)], pairs, 1.0 + 1.5 * width)
        self.scene.add_point_cloud(
            "/patches", reading.points.float().numpy(), colors,
            point_size=reading.side / 4, point_shape="square", precision="float32",
        )  # fmt: skip

    def _lines(self, name: str, lines: Tensor, color: Any, width: float) -> None:
        """Segments (n, 2, 3), `width` pixels wide. color: uint8 RGB of all, or (n, 2, 3) of ends.

        viser 1.1.1 takes colours of ends for linear light, and one colour of all for sRGB.
        """
        points = lines.float().cpu().numpy()
        if np.ndim(color) == 3:
            color = linear_light(color)
        self.scene.add_line_segments(name, points, color, thickness=width, thickness_units="screen")


def linear_light(colors: np.ndarray) -> np.ndarray:
    """uint8 sRGB colours in linear light, uint8."""
    shares = np.asarray(colors) / 255
    light = np.where(shares <= 0.04045, shares / 12.92, ((shares + 0.055) / 1.055) ** 2.4)
    return (255 * light).round().astype(np.uint8)


def frustum_lines(eyes: Tensor, ends: Tensor) -> Tensor:
    """Edges (V * 8, 2, 3) of pyramids from eyes (V, 3) to the corners `ends` (V, 4, 3)."""
    spokes = torch.stack([eyes[:, None].expand_as(ends), ends], 2)
    rims = torch.stack([torch.stack([ends[:, a], ends[:, b]], 1) for a, b in _EDGES], 1)
    return torch.cat([spokes, rims], 1).flatten(0, 1)


def distance_to(look: Look) -> float:
    """Median depth of the opaque Gaussians that the input cameras see, shown world.

    Without cameras the median distance of the Gaussians from their middle.
    """
    gaussians = look.gaussians
    solid = gaussians.means[0, gaussians.opacities[0] > SOLID].detach().cpu()
    solid = solid if len(solid) else gaussians.means[0].detach().cpu()
    if look.views is None:
        found = (solid - solid.median(0).values).norm(dim=-1)
    else:
        cameras = look.views.cameras.to("cpu")
        points = to_camera(solid[None], cameras)[0]
        pixels, size = to_pixels(points, cameras.intrinsics[0]), torch.tensor(cameras.size[::-1])
        seen = (points[..., 2] > 0) & ((pixels >= 0) & (pixels <= size)).all(-1)
        found = points[..., 2][seen] if seen.any() else points.norm(dim=-1)
    return max(float(found.median()) * look.placement.scale, 1e-6)
