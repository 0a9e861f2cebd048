import math
from copy import deepcopy

import numpy as np
import pytest
import torch
from qgs_viewer.choice import FAINT, Choice, painted, query_color
from qgs_viewer.look import NEUTRAL, Look, look_inside
from qgs_viewer.pictures import attention_pictures_of
from qgs_viewer.server import first_eye, quiet_server, stand, up_of
from small import KINDS, SIDE, model_of, source_of

import qgs
from qgs.geometry.poses import look_at
from qgs.geometry.transforms import to_camera, to_pixels
from qgs.types import Cameras, Gaussians, Views


@pytest.mark.parametrize("kind", KINDS)
def test_supports_are_those_of_the_states_of_each_layer(kind: str) -> None:
    look, model = source_of(kind).look((1, 4)), model_of(kind)
    assert look.views is not None
    with torch.no_grad():
        prediction = model(look.views, layers=range(1, model.depth + 1))
    states = [model.queries.start(1), *(layer.state for layer in prediction.layers.values())]
    for layer, state in enumerate(states):
        expected, found = model.queries.support(state), look.support(layer)
        assert (found is None) == (expected is None) == (kind == "tokengs")
        if found is not None and expected is not None:
            torch.testing.assert_close(found.centers, expected.centers.double())
            torch.testing.assert_close(found.axes, expected.axes.double())
    torch.testing.assert_close(look.gaussians.means, prediction.gaussians.means)


@pytest.mark.parametrize("kind", KINDS)
def test_attention_is_that_of_a_trace(kind: str) -> None:
    look, model = source_of(kind).look((1, 4)), model_of(kind)
    with torch.no_grad(), qgs.trace(model, queries=[5]) as record:
        model(look.views)
    for layer in range(1, model.depth + 1):
        found, expected = look.attention(5, layer), record.layers[layer].cross_attention
        assert found is not None
        assert expected is not None
        torch.testing.assert_close(found.weights, expected.weights)
    assert look.attention(5, 0) is None
    parts = {"content", "result"} if kind == "tokengs" else {"content", "geometry", "result"}
    assert attention_pictures_of(look, 5, 1, 32).keys() == parts


def test_lines_end_on_the_patches_that_are_read_most() -> None:
    look = source_of("locus").look((1, 4))
    assert look.views is not None
    assert look.inside is not None
    reading, weights = look.strongest(3, 2, 5, 0.4), look.attention(3, 2)
    assert reading is not None
    assert weights is not None
    shares = weights.weights[0, :, 0].mean(0)
    assert reading.shares.tolist() == sorted(shares.tolist(), reverse=True)[:5]
    _, rows, columns = look.inside.memory.grid
    cameras, patch = look.views.cameras.to(torch.float64), SIDE / columns
    seen = to_camera(reading.points[None], cameras)[0]
    for place, token in enumerate(shares.topk(5).indices.tolist()):
        view, rest = divmod(token, rows * columns)
        row, column = divmod(rest, columns)
        pixel = to_pixels(seen[view, place][None], cameras.intrinsics[0, view])[0]
        middle = torch.tensor([(column + 0.5) * patch, (row + 0.5) * patch]).double()
        torch.testing.assert_close(pixel, middle, rtol=0, atol=1e-3)
        assert seen[view, place, 2] == pytest.approx(0.4)


def test_other_inputs_leave_the_scene_where_it_is() -> None:
    source = source_of("locus")
    every = source.cameras()
    assert every is not None
    for frames in ((1, 4), (4, 1), (0, 2, 5)):
        look = source.look(frames)
        assert look.views is not None
        eyes = look.placement.points(look.views.cameras.c2w[0, :, :3, 3])
        torch.testing.assert_close(eyes, every.c2w[list(frames), :3, 3], rtol=0, atol=1e-5)
        turned = look.placement.rotation @ look.views.cameras.c2w[0, :, :3, :3].double()
        torch.testing.assert_close(turned, every.c2w[list(frames), :3, :3], rtol=0, atol=1e-5)


def test_a_picked_query_stands_out() -> None:
    look = source_of("locus").look((1, 4))
    mine = np.zeros(look.gaussians.count, bool)
    mine[look.members(4)] = True
    plain = painted(look, Choice())
    for others, part in (("faint", FAINT), ("hidden", 0.0), ("shown", 1.0)):
        shown = painted(look, Choice(query=4, others=others))
        np.testing.assert_allclose(shown.opacities[~mine], part * plain.opacities[~mine], rtol=1e-6)
        assert (shown.opacities[mine] >= plain.opacities[mine]).all()
        np.testing.assert_array_equal(shown.colors[mine], plain.colors[mine])
    colored = painted(look, Choice(by_query=True))
    np.testing.assert_allclose(colored.colors[mine] * 255, [query_color(4)] * mine.sum(), atol=0.1)


def test_the_background_is_that_of_the_model() -> None:
    look = source_of("locus").look((1, 4))
    assert look.background == model_of("locus").renderer.config.background == NEUTRAL
    settings = model_of("locus").renderer.config.model_copy(update={"background": (0.1, 0.2, 0.3)})
    model = deepcopy(model_of("locus"))
    model.renderer.config = settings
    assert look.views is not None
    assert look_inside(model, look.views).background == (0.1, 0.2, 0.3)


def around(turn: float, count: int = 8, up: tuple[float, float, float] = (0, 0, 1)) -> Look:
    """Cameras on a part `turn` of a circle of radius 3, upright by `up`, around a small cloud."""
    angles = torch.arange(count) / count * turn * 2 * math.pi
    eye = torch.stack([3 * angles.cos(), 3 * angles.sin(), torch.full((count,), 0.5)], -1)
    c2w = look_at(eye, -eye, -torch.tensor(up).float().expand_as(eye))
    lenses = torch.tensor([64.0, 64, 32, 32]).expand(1, count, 4)
    views = Views(torch.rand(1, count, 3, 64, 64), Cameras(c2w[None], lenses, (64, 64)))
    means = torch.randn(1, 50, 3) * 0.2
    quats = torch.tensor([1.0, 0, 0, 0]).expand(1, 50, 4)
    sizes, solid = torch.full((1, 50, 3), 0.05), torch.full((1, 50), 0.9)
    return Look(Gaussians(means, sizes, quats, solid, means.sigmoid()), views)


def test_cameras_around_something_are_seen_from_outside() -> None:
    look = around(1.0)
    eye, target = first_eye(look)
    middle = look.gaussians.means[0].double().median(0).values.numpy()
    assert abs(target - middle).max() < 1e-6
    assert ((eye - middle) ** 2).sum() ** 0.5 > 4
    assert eye[2] > 0.5  # above them


def test_a_walk_is_seen_from_a_camera_in_its_middle() -> None:
    look = around(1.0)
    assert look.views is not None
    c2w, angles = torch.eye(4).repeat(9, 1, 1), torch.linspace(-2.0, 2.0, 9)
    c2w[:, 0, 3] = 5 * torch.arange(9.0)
    c2w[:, 0, 0], c2w[:, 0, 2] = angles.cos(), angles.sin()
    c2w[:, 2, 0], c2w[:, 2, 2] = -angles.sin(), angles.cos()
    lenses = torch.tensor([64.0, 64, 32, 32]).expand(1, 9, 4)
    cameras = Cameras(c2w[None], lenses, (64, 64))
    look = Look(look.gaussians, Views(torch.rand(1, 9, 3, 64, 64), cameras))
    eye, target = first_eye(look)
    assert eye[:2] == pytest.approx([20, 0], abs=1e-5)
    assert eye[2] > 0
    assert (target - eye)[2] > 0.99 * ((target - eye) ** 2).sum() ** 0.5


def test_up_is_that_of_the_cameras() -> None:
    for turn in (0.2, 1.0):
        up = up_of(around(turn))
        assert float(up[2]) > 0.95
        assert float(up.norm()) == pytest.approx(1)
    look = around(0.2)
    with quiet_server() as server:
        stand(server, look)
        assert server.initial_camera.up[2] > 0.95
    eye, target = first_eye(look)
    assert (target - eye) @ (torch.zeros(3).numpy() - eye) > 0
