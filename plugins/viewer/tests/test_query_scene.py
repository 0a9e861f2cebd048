"""A scene with its queries: supports, attention, colours, and the place it is seen from first."""

import numpy as np
import torch
from numpy.testing import assert_allclose
from qgs_viewer.drawing import FAINT, Choice, painted, query_color
from qgs_viewer.page import first_eye, up_of
from qgs_viewer.queries import PARTS, attention_pictures_of
from qgs_viewer.query_scene import QueryScene
from small import BY_DISTANCE, KINDS, model_scenes_of, source_of
from tables import assert_equal, assert_near
from torch.testing import assert_close
from walk import SIDE, arc, cloud, pinhole

import qgs
from qgs.geometry.poses import scaled
from qgs.geometry.transforms import moved, to_camera, to_pixels
from qgs.types import Views


def test_supports_and_attention_are_those_of_a_traced_pass():
    for kind in KINDS:
        model = model_scenes_of(kind).network
        scene = source_of(kind).scene_of((1, 4))
        with torch.no_grad(), qgs.trace(model) as record:
            assert_close(scene.gaussians.means, model(scene.views).gaussians.means)
        layers = record.layers
        states = [layers[1].before, *(layer.after for layer in layers.values())]
        assert scene.attention(5, 0) is None
        for layer, state in enumerate(states):
            found = scene.support(layer)
            expected = model.queries.support(state)
            assert (found is None) == (expected is None) == (kind == "tokengs")
            if found:
                assert_close(vars(found), vars(expected.to(torch.float64)))
        for layer, traced in layers.items():
            found = scene.attention(5, layer)
            for part, values in vars(traced.cross_attention).items():
                if values is not None:
                    assert_close(getattr(found, part), values[:, :, [5]])
        parts = {"content", "weights"} if kind == "tokengs" else PARTS.keys()
        assert attention_pictures_of(scene, 5, 1, 32).keys() == parts


def test_lines_end_on_the_patches_that_are_read_most():
    scene = model_scenes_of("locus").scene
    points, read, _ = scene.strongest(3, 2, 5, 0.4)
    shares = scene.attention(3, 2).weights[0, :, 0].mean(0).topk(5)
    assert_equal(read, shares.values)
    tokens = shares.indices
    _, rows, columns = scene.grid
    patches = torch.stack([tokens % columns, tokens // columns % rows], -1)
    views = scene.views.cameras.to(torch.float64)
    seen = to_camera(points[None], views)[0]
    place = tokens // (rows * columns), torch.arange(5)
    pixels = to_pixels(seen, views.intrinsics[0])[place]
    assert_equal(pixels, (patches + 0.5).double() * SIDE / columns, atol=1e-3)
    assert_near(seen[place][:, 2], [0.4] * 5)


def test_other_inputs_leave_the_scene_where_it_is():
    source = source_of("locus", BY_DISTANCE)
    expected = source.scene_of((1, 4)).views.cameras.c2w[0]
    for frames in ((4, 1), (4, 5, 1)):
        c2w = source.scene_of(frames).views.cameras.c2w[0, [frames.index(1), frames.index(4)]]
        assert_equal(c2w, expected, atol=1e-5)


def test_a_picked_query_stands_out():
    scene = model_scenes_of("locus").scene
    mine = np.zeros(scene.gaussians.count, bool)
    mine[scene.members(4)] = True
    plain = painted(scene, Choice())
    for others, part in (("faint", FAINT), ("hidden", 0.0), ("shown", 1.0)):
        shown = painted(scene, Choice(query=4, others=others))
        assert_near(shown.opacities[~mine], part * plain.opacities[~mine])
        assert (shown.opacities[mine] >= plain.opacities[mine]).all()
        assert (shown.colors[mine] == plain.colors[mine]).all()
    colored = painted(scene, Choice(by_query=True))
    assert_allclose(colored.colors[mine] * 255, [query_color(4)] * mine.sum(), atol=0.1)


PLACE = torch.tensor([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 5], [0, 0, 0, 1]]).double()


def scene_from(c2w):
    """At a cloud around the origin, shown with z up, twice as large, around (0, 0, 5)."""
    images = torch.rand(1, len(c2w), 3, SIDE, SIDE)
    cameras = pinhole((PLACE @ scaled(c2w.double(), 2.0)).float())[None]
    return QueryScene(moved(cloud(50), PLACE, 2.0), Views(images, cameras))


CIRCLE = arc(range(0, 360, 45), 3)


def test_cameras_around_something_are_seen_from_outside():
    eye, target = first_eye(scene_from(CIRCLE))
    assert np.linalg.norm(eye - [0, 0, 5]) > 7
    assert np.linalg.norm(target - [0, 0, 5]) < 1
    assert eye[2] > 6  # above them


def test_a_walk_is_seen_from_a_camera_in_its_middle():
    c2w = arc(range(-120, 121, 30), 0)
    c2w[:, 0, 3] = 5 * torch.arange(9)
    eye, target = first_eye(scene_from(c2w))
    assert_allclose(eye[[0, 2]], [40, 5], 0, 1e-5)
    assert eye[1] > 0
    assert (target - eye)[1] > 0.99 * np.linalg.norm(target - eye)


def test_up_is_that_of_the_cameras():
    few = scene_from(CIRCLE[:3])
    for scene in (few, scene_from(CIRCLE)):
        up = up_of(scene)
        assert up[2] > 0.95
        assert_near(up.norm(), 1)
    eye, target = first_eye(few)
    assert (target - eye) @ ([0, 0, 5] - eye) > 0
