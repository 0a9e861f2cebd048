"""Scenes as they are drawn: what their seed, their options and their views say."""

import numpy as np
import pytest
from qgs_worlds.caster import tables as s
from qgs_worlds.caster.shapes import packed
from qgs_worlds.rooms.source import RoomScene, RoomsConfig, RoomsSource
from qgs_worlds.worlds.places import PLACES
from qgs_worlds.worlds.source import WorldsSource
from tables import assert_equal, assert_near
from test_intervals import met
from torch.testing import assert_close

from qgs.geometry.rays import pixel_directions

SIZE = 16, 24


def source(**options):
    return WorldsSource(WorldsSource.Config(**{"image_size": SIZE, **options}))


@pytest.fixture(scope="module")
def scenes():
    """Scenes of the training split, drawn."""
    return source().scenes("train")[:60]


def test_depth_is_that_of_the_nearest_shape(scenes):
    random = np.random.default_rng(0)
    for scene in scenes[:6]:
        world = scene.drawn.world
        camera = scene.cameras[2]
        scale = scene.drawn.scale
        c2w = camera.c2w.double().numpy()
        depth = scene.depths([2])[0, 0].numpy()
        ways = pixel_directions(camera.intrinsics, SIZE).double().numpy()
        for i, j in random.integers(SIZE, size=(10, 2)):
            ray = c2w[:3, 3] / scale, c2w[:3, :3] @ ways[i, j]
            nearest = min(met(shape, world.heights, *ray) for shape in world.shapes[:, None])
            true = nearest * scale if np.isfinite(nearest) else 0
            assert_near(depth[i, j], true, rtol=2e-3)


def test_scenes_are_scaled_to_their_depth():
    scaled = source(depth=(2.0, 2.0), image_size=(10, 10)).scenes("train")
    drawn = source(depth=None, image_size=(10, 10)).scenes("train")
    for index in range(3):
        scene = scaled[index]
        factor = scene.drawn.scale
        depths = scene.depths(range(8))
        assert_near(depths[depths > 0].median(), 2, rtol=0.01)
        moved = scene.cameras.c2w[:, :3, 3]
        own = drawn[index].depths(range(8)), drawn[index].cameras.c2w[:, :3, 3]
        assert_close((depths, moved), tuple(x * factor for x in own))
        assert_equal(scene.images([1]), drawn[index].images([1]))


def test_a_share_of_scenes_are_rooms():
    mixed = source(rooms=0.25).scenes("train")
    rooms = RoomsSource(RoomsConfig(image_size=SIZE)).scenes("train")
    drawn = [index for index in range(200) if isinstance(mixed[index], RoomScene)]
    assert 35 < len(drawn) < 65
    assert_equal(mixed[drawn[0]].images([3]), rooms[drawn[0]].images([3]))


def test_what_is_drawn_is_spread(scenes):
    rigs = [scene.drawn.rig for scene in scenes]
    c2w = np.stack([rig.c2w for rig in rigs])
    fov = [rig.fov for rig in rigs]
    assert 18 <= min(fov) < 23 < 85 < max(fov) <= 90
    widest = np.linalg.norm(np.ptp(c2w[..., :3, 3], 1), axis=-1)
    low, middle, high = np.quantile(widest, (0.02, 0.5, 0.98))
    assert high / low > 100
    assert 0.1 < middle < 2
    assert {rig.motion for rig in rigs} >= {"walk", "orbit", "round", "gather"}
    kinds = [scene.drawn.place.kind for scene in scenes]
    assert all(kinds.count(kind) > 10 for kind in PLACES)
    shapes = np.concatenate([scene.drawn.world.shapes for scene in scenes])
    assert {*shapes["body"]["kind"]} == {*range(6)}
    assert (shapes["cut"]["kind"] >= 0).mean() > 0.05
    assert 3 < np.abs(np.degrees(np.arcsin(c2w[..., 2, 0]))).max() < 20


def test_complexity_rations_the_shapes(scenes):
    few = source(complexity=4).scenes("train")[:10]
    counts = [np.mean([len(scene.drawn.world.shapes) for scene in each]) for each in (few, scenes)]
    assert 2 * counts[0] < counts[1]


@pytest.fixture(scope="module")
def plain():
    """The first scenes, by the option that is off."""
    off = dict.fromkeys(("cameras", "shapes", "textures", "light"), "plain")
    return {
        name: [scene.drawn for scene in source(**{name: value}).scenes("train")[:3]]
        for name, value in (off | {"effects": False}).items()
    }


def test_plain_parts(plain):
    for drawn in plain["cameras"]:
        assert 60 <= drawn.rig.fov <= 75
        assert np.abs(drawn.rig.c2w[:, 2, 0]).max() < 1e-9, "no roll"
    for drawn in plain["shapes"]:
        assert drawn.place.kind == "indoors"
        inner = drawn.world.shapes["body"][drawn.place.fixed :]
        assert {*inner["kind"]} <= {s.BOX, s.ELLIPSOID, s.FRUSTUM}
        assert (drawn.world.shapes["cut"]["kind"] == s.NOTHING).all(), "closed"
        assert not inner["axes"][:, [0, 1, 2, 2], [2, 2, 0, 1]].any(), "upright"
    for drawn in plain["textures"]:
        assert drawn.world.textures["octaves"].max() <= 1
        assert s.GLYPHS not in drawn.world.textures["pattern"]
    for drawn in plain["light"]:
        assert drawn.world.lights["shadows"].tolist() == [0]
    for drawn in plain["effects"]:
        assert drawn.effects.quality == 0
        assert np.ptp(drawn.effects.gains) == 0


def parts(drawn):
    """What is drawn for a scene; its cameras decide which shapes stay."""
    textures = drawn.world.textures
    gloss = ["specular", "shine"]
    effects = drawn.effects
    return {
        "shapes": packed(drawn.place.shapes),
        "c2w": drawn.rig.c2w,
        "colours": textures[[name for name in s.TEXTURE.names if name not in gloss]],
        "gloss": textures[gloss],
        "lights": drawn.world.lights,
        "air": drawn.world.air,
        "grain": (effects.gamma, effects.vignette, effects.noise, effects.seed),
    }


def test_an_option_changes_its_own_part_alone(plain, scenes):
    one = parts(scenes[2].drawn)
    for option, changed in {
        "cameras": {"c2w"},
        "textures": {"colours", "gloss"},
        "light": {"gloss", "lights", "air"},
        "effects": {"grain"},
    }.items():
        other = parts(plain[option][2])
        assert {name for name in one if not np.array_equal(one[name], other[name])} == changed
