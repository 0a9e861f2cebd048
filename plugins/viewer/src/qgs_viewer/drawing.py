"""Draw Gaussians, photos, anchors and a picked query in the viewer (viser)."""

import colorsys
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
import viser
from torch import Tensor
from viser.transforms import SO3

from qgs.drawing.images import rgb_picture
from qgs.geometry.transforms import depths_in_view
from qgs_viewer.look import INK, Color, enlarged
from qgs_viewer.placement import Splats, corners, on_photo
from qgs_viewer.query_scene import QueryScene

Others = Literal["shown", "faint", "hidden"]
# Mean of a background below which dark lines could not be seen.
DARK = 0.3
# Opacity of the Gaussians of other queries, as a part of their own.
FAINT = 0.12
# Part of the background in the colours of Gaussians that are not picked.
PALE = 0.4
# Pixels on the longer side of photos: small ones are enlarged, large reduced.
PHOTO_SIDE = 256
# Depth of a camera's frustum, per distance from the input cameras to the scene.
FRUSTUM = 0.12
# Opacity of the Gaussians that count for the size of a scene.
SOLID = 0.1


@dataclass(frozen=True)
class Choice:
    """Choices of what the viewer shows.

    query: index of the picked query; None for all. by_query: whether to colour Gaussians by query.
    layer: decoder layer whose anchors and attention are shown; 0 is before the first layer. others:
    look of the Gaussians of queries that are not picked: "shown", "faint" or "hidden". patches:
    number of lines from the picked query to the patches that it attends to most. anchors, photos:
    False hides the anchors or the photos.
    """

    query: int | None = None
    by_query: bool = False
    layer: int = 0
    others: Others = "faint"
    patches: int = 24
    anchors: bool = True
    photos: bool = True


def query_color(query: int) -> Color:
    """Return the RGB colour of a query; colours of consecutive queries differ clearly."""
    # multiples of the golden ratio spread over the circle of hues however many there are
    hue = (query * 0.61803398875) % 1
    light = (0.45, 0.6, 0.52)[query % 3]
    red, green, blue = colorsys.hls_to_rgb(hue, light, 0.8)
    return round(red * 255), round(green * 255), round(blue * 255)


def query_colors(scene: QueryScene) -> np.ndarray:
    """Return the colours of all N queries of `scene`, uint8 RGB (N, 3)."""
    return np.array([*map(query_color, range(scene.queries))], np.uint8)


def anchor_colors(scene: QueryScene, choice: Choice) -> np.ndarray:
    """Return the colours of the anchors of all N queries, uint8 RGB (N, 3).

    If a query is picked, the anchors of all other queries are pale, unless `choice.others` is
    "shown".
    """
    colors = query_colors(scene)
    if choice.query is None or choice.others == "shown":
        return colors
    # anchors of others stay visible, so that they can still be clicked
    paled = faded(colors, 0.3, scene)
    paled[choice.query] = colors[choice.query]
    return paled


def faded(
    colors: np.ndarray | Color, strength: float | np.ndarray, scene: QueryScene
) -> np.ndarray:
    """Mix uint8 RGB colours with the background colour of `scene`.

    strength: share of `colors` in the mixture, from 0 (only background) to 1 (only `colors`).
    """
    mixed = strength * np.array(colors) + (1 - strength) * 255 * np.array(scene.background)
    return mixed.round().astype(np.uint8)


def ink(scene: QueryScene) -> Color:
    """Return the RGB colour for lines over `scene`: light on a dark background, else dark."""
    return INK if np.mean(scene.background) > DARK else (235, 235, 235)


def painted(scene: QueryScene, choice: Choice) -> Splats:
    """Return the Gaussians of `scene` in the viewer's world, coloured and faded for `choice`."""
    found = scene.splats
    colors = found.colors
    opacities = found.opacities
    # Gaussians are ordered by query, so colours repeat in blocks
    if choice.by_query:
        colors = query_colors(scene).repeat(len(colors) // scene.queries, 0) / 255
    if choice.query is not None and choice.others != "shown":
        mine = np.zeros((len(colors), 1), bool)
        mine[scene.members(choice.query)] = True
        part = FAINT if choice.others == "faint" else 0.0
        # nearly clear Gaussians of the picked query would not be seen
        opacities = np.where(mine, np.maximum(opacities, 0.5), opacities * part)
        greys = colors.mean(1, keepdims=True) * (1 - PALE) + np.array(scene.background) * PALE
        colors = np.where(mine, colors, greys)
    return replace(found, colors=colors.astype(np.float32), opacities=opacities.astype(np.float32))


class Drawing:
    """Drawing of a scene with viser. Each method replaces what it has drawn before.

    photo_depth: distance from a camera at which its photo is drawn. anchor_radius: radius of the
    dots that show anchors. Both are in units of the viewer's world.
    """

    def __init__(self, api: viser.SceneApi) -> None:
        self.api = api
        self._painted: tuple[Any, ...] = ()

    def put(self, scene: QueryScene, choice: Choice) -> None:
        """Draw a whole scene in place of the scene drawn before."""
        unit = distance_to(scene)
        self.photo_depth = FRUSTUM * unit
        self.anchor_radius = 0.01 * unit
        # viser has a background picture, and no background colour
        plain = np.full((8, 8, 3), faded(INK, 0.0, scene))
        self.api.set_background_image(plain, "png")
        self._draw_photos(scene)
        self.update(scene, choice)

    def update(self, scene: QueryScene, choice: Choice) -> None:
        """Draw the scene again, except photos and background, which do not depend on `choice`."""
        self._draw_gaussians(scene, choice)
        if (views := self.api.get_handle_by_name("/views")) is not None:
            views.visible = choice.photos
        # another choice may have none of them
        for name in ("/anchors", "/support", "/path", "/reading", "/patches"):
            self.api.remove_by_name(name)
        found = scene.support(choice.layer)
        if found is not None and choice.anchors:
            self.api.add_point_cloud(
                "/anchors",
                found.centers[0].float().numpy(),
                anchor_colors(scene, choice),
                point_size=self.anchor_radius,
                point_shape="circle",
                precision="float32",
            )
        if choice.query is not None:
            self._draw_support(scene, choice.query, choice.layer)
            self._draw_reading(scene, choice.query, choice)

    def _draw_gaussians(self, scene: QueryScene, choice: Choice) -> None:
        paint = (scene, choice.by_query, choice.query, choice.others)
        # Gaussians are megabytes to send; most choices leave them as they are
        if paint == self._painted:
            return
        shown = painted(scene, choice)
        factor = shown.magnification
        centers = shown.centers * factor
        covariances = shown.covariances * factor**2
        contents = (centers, covariances, shown.colors, shown.opacities)
        handle: Any = self.api.get_handle_by_name("/gaussians")
        if handle is None:
            handle = self.api.add_gaussian_splats("/gaussians", *contents)
        else:
            handle.set_gaussians(*contents)
        # centres and covariances are magnified, see `Splats.magnification`
        handle.scale = 1 / factor
        self._painted = paint

    def _draw_photos(self, scene: QueryScene) -> None:
        self.api.remove_by_name("/views")
        if scene.views is None:
            return
        # one switch shows and hides all below it
        self.api.add_frame("/views", show_axes=False)
        cameras = scene.views.cameras[0].to("cpu", torch.float64)
        ends = on_photo(cameras, corners(cameras.size), self.photo_depth)
        eyes = cameras.c2w[:, :3, 3]
        # the edges of pyramids: from the eyes to the corners, and around the photos
        spokes = torch.stack([eyes[:, None].expand_as(ends), ends], 2)
        rims = torch.stack([ends, ends.roll(-1, 1)], 2)
        edges = torch.cat([spokes, rims], 1).flatten(0, 1)
        self._lines("/views/inputs", edges, ink(scene), 2.0)
        for view, image in enumerate(scene.views.images[0]):
            corner, right, _, left = ends[view]
            # viser's pictures lie in the plane of x and y, as those of cameras do
            turned = cameras.c2w[view, :3, :3]
            # viser's frusta have their principal point in the middle, photos may not
            self.api.add_image(
                f"/views/{view}",
                enlarged(rgb_picture(image), PHOTO_SIDE),
                float((right - corner).norm()),
                float((left - corner).norm()),
                wxyz=SO3.from_matrix(turned.numpy()).wxyz,
                position=ends[view].mean(0).numpy(),
            )

    def _draw_support(self, scene: QueryScene, query: int, layer: int) -> None:
        """Draw the support ellipsoid of a query, and the path of the query's anchor.

        The path leads from layer 0 to `layer`. Nothing is drawn if queries have no anchors.
        """
        supports = [scene.support(number) for number in range(layer + 1)]
        points = [found.centers[0, query] for found in supports if found is not None]
        found = supports[-1]
        if found is None:
            return
        axes = found.axes[0, query]
        # viser's ball takes lengths and a rotation for the semi-axes
        lengths = axes.norm(dim=0)
        x, y, z = lengths.tolist()
        self.api.add_icosphere(
            "/support",
            color=query_color(query),
            subdivisions=2,
            scale=(x, y, z),
            wireframe=True,
            opacity=0.5,
            cast_shadow=False,
            receive_shadow=False,
            wxyz=SO3.from_matrix((axes / lengths).numpy()).wxyz,
            position=points[-1].numpy(),
        )
        if layer:
            path = torch.stack(points)
            self._lines("/path", torch.stack([path[:-1], path[1:]], 1), ink(scene), 3.0)

    def _draw_reading(self, scene: QueryScene, query: int, choice: Choice) -> None:
        """Draw lines from a query to the photo patches that it attends to most in a layer.

        Lines start at the query's anchor before the layer and end in a square of half the patch's
        width. More attention gives a stronger colour, relative to the patch with the most
        attention.
        """
        if not choice.patches:
            return
        # a little nearer to the camera than the photo, which would hide the squares
        depth = 0.97 * self.photo_depth
        reading = scene.strongest(query, choice.layer, choice.patches, depth)
        if reading is None:
            return
        points, shares, side = reading
        hub = scene.hub(query, choice.layer - 1).expand_as(points)
        strengths = (shares / shares.max().clamp_min(1e-30)).numpy()
        colors = faded(query_color(query), strengths[:, None], scene)
        ends = torch.stack([hub, points], 1)
        self._lines("/reading", ends, colors[:, None].repeat(2, 1), 2.5)
        self.api.add_point_cloud(
            "/patches",
            points.float().numpy(),
            colors,
            point_size=side / 4,
            point_shape="square",
            precision="float32",
        )

    def _lines(self, name: str, lines: Tensor, color: Any, width: float) -> None:
        """Draw n line segments (n, 2, 3), each `width` pixels wide.

        color: uint8 RGB; one colour for all segments, or (n, 2, 3) with a colour for each end.
        """
        points = lines.float().cpu().numpy()
        self.api.add_line_segments(name, points, color, thickness=width, thickness_units="screen")


def distance_to(scene: QueryScene) -> float:
    """Return the distance to the scene: the median depth of opaque Gaussians in input cameras.

    Without cameras, it is the median distance of opaque Gaussians from their median position. The
    unit is that of the viewer's world.
    """
    means = scene.gaussians.means[0].detach().cpu()
    # Gaussians that nobody sees may lie anywhere
    solid = means[(scene.gaussians.opacities[0] > SOLID).cpu()]
    if not len(solid):
        solid = means
    if scene.views is None:
        found = (solid - solid.median(0).values).norm(dim=-1)
    else:
        cameras = scene.views.cameras.to("cpu")
        depths = depths_in_view(solid, cameras)
        found = depths[~depths.isnan()]
        if not len(found):
            found = torch.cdist(cameras.c2w[0, :, :3, 3], solid)
    # a scene of one point has no size, and frusta of none would be invisible
    return max(float(found.median()), 1e-6)
