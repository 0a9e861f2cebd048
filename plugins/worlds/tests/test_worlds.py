import numpy as np
import pytest
import torch
from pydantic import ValidationError
from qgs_rooms.source import RoomScene, RoomsConfig, RoomsSource
from qgs_worlds import rows as r
from qgs_worlds.effects import develop
from qgs_worlds.places import KINDS
from qgs_worlds.shapes import packed
from qgs_worlds.source import WorldsSource
from test_intervals import met

from qgs.geometry.rays import pixel_directions


def source(**options) -> WorldsSource:
    return WorldsSource(WorldsSource.Config(**{"image_size": (32, 48), **options}))


@pytest.fixture(scope="module")
def scenes():
    """Scenes of the training split, drawn."""
    return source(image_size=(24, 24)).scenes("train")[:120]


def test_a_scene_is_a_function_of_seed_split_and_index():
    first, again = source().scenes("train")[7], source(scenes=9, cache_mb=0).scenes("train")[7]
    assert torch.equal(first.images([3, 1]), again.images([3, 1]))
    assert torch.equal(first.images([1]), first.images([3, 1])[1:])
    for other in (source().scenes("test")[7], source(seed=1).scenes("train")[7]):
        assert not torch.equal(first.images([1]), other.images([1]))


def test_images_do_not_depend_on_threads(monkeypatch):
    def drawn(threads: int) -> tuple[torch.Tensor, torch.Tensor]:
        monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
        scene = source(image_size=(130, 40)).scenes("test")[3]
        return scene.images([0, 4]), scene.depths([0, 4])

    for one, three in zip(drawn(1), drawn(3), strict=True):
        assert torch.equal(one, three)


@pytest.mark.parametrize("size", [(17, 33), (130, 5)])
def test_any_size(size):
    scene = source(image_size=size).scenes("test")[0]
    images, depths = scene.images([0, 5]), scene.depths([0, 5])
    assert images.shape == (2, 3, *size)
    assert depths.shape == (2, 1, *size)
    assert depths.min() >= 0
    assert torch.isfinite(depths).all()
    assert 0 <= images.min() < images.max() <= 1


@pytest.mark.parametrize(
    "wrong", [{"scenes": 0}, {"complexity": 2}, {"light": "dark"}, {"depth": (2, 1)}, {"rooms": 2}]
)
def test_wrong_options_are_refused(wrong):
    with pytest.raises(ValidationError):
        source(**wrong)


def test_slices_and_range():
    scenes = source(scenes=5).scenes("train")
    assert [scene.name for scene in scenes[3:]] == ["train/000003", "train/000004"]
    with pytest.raises(IndexError):
        scenes[5]


def test_depth_is_that_of_the_nearest_shape():
    random = np.random.default_rng(0)
    for index in range(6):
        scene = source().scenes("train")[index]
        world, camera = scene.drawn.world, scene.cameras[2]
        depth = scene.depths([2])[0, 0].numpy()
        ways = pixel_directions(camera.intrinsics, camera.size).double().numpy()
        turn = scene.drawn.rig.c2w[2]
        for i, j in random.integers((32, 48), size=(15, 2)):
            ray = turn[:3, 3], turn[:3, :3] @ ways[i, j]
            nearest = min(met(shape[None], world.heights, *ray) for shape in world.shapes)
            true = nearest * scene.drawn.scale if np.isfinite(nearest) else 0
            assert depth[i, j] == pytest.approx(true, rel=2e-3)


def test_scenes_are_scaled_to_their_depth():
    scaled, drawn = (
        source(depth=depth, image_size=(10, 10)).scenes("train") for depth in ((2.0, 2.0), None)
    )
    for index in range(8):
        depths = scaled[index].depths(range(8))
        assert depths[depths > 0].median() == pytest.approx(2, rel=0.01)
        factor = scaled[index].drawn.scale
        torch.testing.assert_close(depths, drawn[index].depths(range(8)) * factor)
        moved = scaled[index].cameras.c2w[:, :3, 3], drawn[index].cameras.c2w[:, :3, 3]
        torch.testing.assert_close(moved[0], moved[1] * factor)
        assert torch.equal(scaled[index].images([1]), drawn[index].images([1]))


def test_a_share_of_scenes_are_rooms():
    mixed = source(rooms=0.25).scenes("train")
    rooms = RoomsSource(RoomsConfig(image_size=mixed[0].cameras.size)).scenes("train")
    drawn = [index for index in range(400) if isinstance(mixed[index], RoomScene)]
    assert 70 < len(drawn) < 130
    assert torch.equal(mixed[drawn[0]].images([3]), rooms[drawn[0]].images([3]))
    assert not any(isinstance(scene, RoomScene) for scene in source().scenes("train")[:50])


def test_depths_of_two_views_agree():
    """What one view sees is rarely before what another one sees along the same ray."""
    before, alike = [], []
    for index in range(20):
        scene = source(image_size=(64, 64)).scenes("train")[index]
        cameras, depths = scene.cameras[[2, 4]], scene.depths([2, 4])[:, 0]
        points = pixel_directions(cameras.intrinsics[0], cameras.size) * depths[0, ..., None]
        world = points @ cameras.c2w[0, :3, :3].T + cameras.c2w[0, :3, 3]
        local = world @ cameras.w2c[1, :3, :3].T + cameras.w2c[1, :3, 3]
        fx, fy, cx, cy = cameras.intrinsics[1]
        u, v = fx * local[..., 0] / local[..., 2] + cx, fy * local[..., 1] / local[..., 2] + cy
        seen = (depths[0] > 0) & (local[..., 2] > 0.1) & (u > 1) & (u < 63) & (v > 1) & (v < 63)
        i, j = v[seen].long(), u[seen].long()
        # the range of depths about the pixel, as edges and slopes move within it
        around = torch.stack(
            [depths[1, i + a, j + b] for a in (-1, 0, 1) for b in (-1, 0, 1) if (i + a < 64).all()]
        )
        around = torch.where(around > 0, around, torch.inf)
        z = local[..., 2][seen]
        low, high = around.min(0).values * 0.98, around.max(0).values * 1.02
        before.append((z < low).float().mean())
        alike.append(((z >= low) & (z <= high)).float().mean())
    assert np.nanmean(before) < 0.02
    assert np.nanmean(alike) > 0.8


def distances(shapes: np.ndarray, eyes: np.ndarray) -> np.ndarray:
    """Metres (F, S) from points to the boxes around shapes, 0 inside."""
    half = shapes[:, None, r.HALF : r.HALF + 3].astype(float)
    turn = shapes[:, r.MATRIX : r.CENTER].reshape(-1, 3, 3) * half.transpose(0, 2, 1)
    local = np.einsum("sij,fsj->fsi", turn, eyes[:, None] - shapes[None, :, r.CENTER : r.HALF])
    extent = half[:, 0] * shapes[:, r.EXTENT : r.EXTENT + 3]
    return np.linalg.norm(np.maximum(np.abs(local) - extent, 0), axis=-1)


def test_cameras_are_rigid_and_keep_clear_of_every_surface(scenes):
    for scene in scenes:
        c2w = scene.drawn.rig.c2w
        assert distances(scene.drawn.world.shapes, c2w[:, :3, 3]).min() > 0.15
        assert np.abs(c2w[:, :3, :3] @ c2w[:, :3, :3].transpose(0, 2, 1) - np.eye(3)).max() < 1e-9
        assert np.linalg.det(c2w[:, :3, :3]).min() > 0.99
        assert c2w[:, 2, 1].max() < 0, "the image's y axis points down"


def test_what_is_drawn_is_spread(scenes):
    rigs = [scene.drawn.rig for scene in scenes]
    fov = np.array([rig.fov for rig in rigs])
    assert 18 <= fov.min() < 23 < 85 < fov.max() <= 90
    eyes = np.stack([rig.c2w[:, :3, 3] for rig in rigs])
    widest = np.linalg.norm(eyes[:, :, None] - eyes[:, None], axis=-1).max((1, 2))
    low, middle, high = np.quantile(widest, (0.02, 0.5, 0.98))
    assert high / low > 100
    assert 0.1 < middle < 2
    assert {rig.motion for rig in rigs} >= {"walk", "orbit", "round", "gather"}
    kinds = [scene.drawn.place.kind for scene in scenes]
    assert all(kinds.count(kind) > 15 for kind in KINDS)
    shapes = np.concatenate([scene.drawn.world.shapes for scene in scenes])
    assert {*shapes[:, r.KIND].astype(int)} == set(range(6))
    assert (shapes[:, r.PRIMITIVE_FIELDS] >= 0).mean() > 0.05
    roll = np.degrees([np.arcsin(rig.c2w[:, 2, 0]) for rig in rigs])
    assert 3 < np.abs(roll).max() < 20


def test_few_views_are_featureless_or_all_sky(scenes):
    images = torch.cat([scene.images([1, 6]) for scene in scenes]).mean(1)
    assert (images.flatten(1).std(1) < 0.03).float().mean() < 0.1
    sky = torch.cat([scene.depths([1, 6]) for scene in scenes]) == 0
    assert (sky.flatten(1).float().mean(1) > 0.8).float().mean() < 0.05
    means = images.flatten(1).mean(1)
    assert 0.3 < means.mean() < 0.6


def test_complexity_rations_the_shapes():
    def mean(complexity: int) -> float:
        scenes = source(complexity=complexity).scenes("train")[:25]
        return float(np.mean([len(scene.drawn.world.shapes) for scene in scenes]))

    assert 2 * mean(4) < mean(32)


def plain(**options):
    return [scene.drawn for scene in source(**options).scenes("train")[:12]]


def test_plain_parts():
    for drawn in plain(cameras="plain"):
        assert 60 <= drawn.rig.fov <= 75
        assert np.abs(drawn.rig.c2w[:, 2, 0]).max() < 1e-9, "no roll"
    for drawn in plain(shapes="plain"):
        assert drawn.place.kind == "indoors"
        inner = drawn.world.shapes[drawn.place.fixed :]
        assert {*inner[:, r.KIND].astype(int)} <= {r.BOX, r.ELLIPSOID, r.FRUSTUM}
        assert (drawn.world.shapes[:, r.PRIMITIVE_FIELDS] == r.NOTHING).all(), "closed"
        assert np.abs(inner[:, [r.MATRIX + k for k in (2, 5, 6, 7)]]).max() == 0, "upright"
    for drawn in plain(textures="plain"):
        assert drawn.world.textures[:, r.OCTAVES].max() <= 1
        assert r.GLYPHS not in drawn.world.textures[:, r.PATTERN]
    for drawn in plain(light="plain"):
        assert drawn.world.lights.shape == (1, r.LIGHT_FIELDS)
        assert drawn.world.lights[0, r.SHADOWS] == 0
    for drawn in plain(effects=False):
        assert drawn.quality == 0
        assert np.ptp(drawn.effects[:3]) == 0


def parts(**options) -> dict[str, np.ndarray]:
    """What is drawn for a scene; its cameras decide which shapes stay."""
    drawn = source(**options).scenes("train")[4].drawn
    return {
        "shapes": packed(drawn.place.shapes),
        "c2w": drawn.rig.c2w,
        "colours": np.delete(drawn.world.textures, [r.SPECULAR, r.SHINE], 1),
        "gloss": drawn.world.textures[:, [r.SPECULAR, r.SHINE]],
        "lights": drawn.world.lights,
        "air": drawn.world.air,
        "grain": drawn.effects[r.GAMMA :],
    }


@pytest.mark.parametrize(
    ("option", "changed"),
    [
        ({"cameras": "plain"}, {"c2w"}),
        ({"textures": "plain"}, {"colours", "gloss"}),
        ({"light": "plain"}, {"gloss", "lights", "air"}),
        ({"effects": False}, {"grain"}),
    ],
)
def test_an_option_changes_its_own_part_alone(option, changed):
    one, other = parts(), parts(**option)
    assert {name for name in one if not np.array_equal(one[name], other[name])} == changed


def test_all_views_of_a_scene_are_developed_alike():
    light = np.random.default_rng(0).random((16, 16, 3)).astype(np.float32)
    for scene in source().scenes("train")[:20]:
        effects = scene.drawn.effects
        images = np.empty((2, 16, 16, 3), np.uint8)
        for frame in range(2):
            develop(images[frame], light, effects, frame)
        apart = np.abs(images[0].astype(float) - images[1])
        assert apart.mean() <= 255 * 2 * effects[r.NOISE]
        if not effects[r.NOISE]:
            assert not apart.any()


def test_more_samples_change_edges_only():
    coarse = source(samples=1).scenes("train")[0].images([0])
    fine = source(samples=4).scenes("train")[0].images([0])
    assert 0 < (coarse - fine).abs().mean() < 0.08
