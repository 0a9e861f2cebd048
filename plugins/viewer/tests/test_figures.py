"""What the figures draw, in numbers, with small untrained models."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from PIL import Image
from qgs_viewer.figures import anchors, attention, dispersion, novel_views
from qgs_viewer.figures.exhibits import Exhibition, NothingToShowError
from qgs_viewer.figures.outside import plan_of
from qgs_viewer.figures.paper import DPI, WIDTH, chosen_layers, new_figure, write_figure
from qgs_viewer.pictures import error_picture
from small import QUERIES, SIDE, exhibit_of, exhibition_of

import qgs
from qgs.contracts import MetricInput
from qgs.drawing.images import depth_picture, depth_range, rgb_picture
from qgs.geometry.transforms import to_camera, to_pixels
from qgs.metrics import Dispersion

PAIR = ("tokengs", "locus")


def pictures(axes: list[Axes]) -> list[np.ndarray]:
    """What the panels show that show a picture."""
    return [np.asarray(axis.images[0].get_array()) for axis in axes if axis.images]


def words(axes: list[Axes]) -> list[str]:
    return [text.get_text() for axis in axes for text in axis.texts]


def errors_of(show: Exhibition) -> torch.Tensor:
    """Of all models in the middle target of all samples."""
    found = []
    for sample in show.samples:
        views = sample.targets.select(slice(1, 2))
        for model in show.models.values():
            with torch.no_grad():
                image = model.render(model(sample.inputs).gaussians, views.cameras).rgb[0, 0]
            found.append((image.clamp(0, 1) - views.images[0, 0]).abs().mean(0))
    return torch.stack(found)


def test_novel_views_show_the_middle_target_with_its_score_and_error() -> None:
    show = exhibition_of(*PAIR)
    axes = novel_views.made(show).figure.axes
    sample, model = show.samples[0], exhibit_of("locus").model
    with torch.no_grad():
        camera = sample.targets.cameras[:, 1:2]
        image = model.render(model(sample.inputs).gaussians, camera).rgb[0, 0]
    truth = sample.targets.images[0, 1]
    score = -10 * math.log10(float((image.clamp(0, 1) - truth).square().mean()))
    assert f"{score:.2f} dB" in words(axes)
    shown = pictures(axes)
    error = (image.clamp(0, 1) - truth).abs().mean(0)
    for expected in (truth, image, sample.inputs.images[0, 1]):
        assert any(np.array_equal(rgb_picture(expected), found) for found in shown)
    scale = depth_range(errors_of(show))[1]
    assert any(np.array_equal(error_picture(error[None], scale), found) for found in shown)


@pytest.mark.parametrize("kinds", [PAIR, PAIR[:1]])
def test_depths_of_a_scene_have_one_scale_and_the_true_one_a_column(kinds: tuple[str, ...]) -> None:
    show = exhibition_of(*kinds)
    true = torch.linspace(1, 9, 2 * SIDE * SIDE).view(2, 1, SIDE, SIDE)
    first, second = show.samples
    known = replace(first, targets=replace(first.targets, depths=true[None]))
    made = novel_views.made(replace(show, samples=[known, second]))
    titled = {axis.get_title(loc="left"): axis for axis in made.figure.axes}
    sample, maps = show.samples[0], [true[1]]
    for model in show.models.values():
        with torch.no_grad():
            gaussians = model(sample.inputs).gaussians
            maps.append(model.render(gaussians, sample.targets.cameras[:, 1:2]).depth[0, 0])
    near, far = depth_range(torch.cat(maps))
    shown = pictures(made.figure.axes)
    for found in maps:
        assert any(np.array_equal(depth_picture(found, near, far), one) for one in shown)
    assert words([titled["true depth"]]) == [f"{near:.2g} to {far:.2g}"]
    assert "the true depth, which is shown" in made.caption
    without = novel_views.made(show)
    assert "true depth" not in [axis.get_title(loc="left") for axis in without.figure.axes]
    assert "true depth" not in without.caption


def test_bars_are_the_metric_of_each_scene() -> None:
    show = exhibition_of(*PAIR)
    (mean, median) = dispersion.made(show).figure.axes
    metric = Dispersion(Dispersion.Config())
    for number, model in enumerate(show.models.values()):
        for axis, name in ((mean, "mean"), (median, "median")):
            expected = []
            for sample in show.samples:
                with torch.no_grad():
                    gaussians = model(sample.inputs).gaussians
                each, views = gaussians.count // QUERIES, sample.targets
                given = MetricInput(views.images, views, gaussians, each)
                expected.append(float(metric(given)[name].mean()))
            bars = axis.containers[number]
            np.testing.assert_allclose([b.get_height() for b in bars], expected, rtol=1e-5)
            line = axis.lines[number].get_ydata()
            np.testing.assert_allclose(line, np.mean(expected), rtol=1e-5)


def test_anchors_are_shown_layer_by_layer_of_models_that_have_them() -> None:
    made = anchors.anchors(exhibition_of(*PAIR))
    axes = made.figure.axes
    layers = chosen_layers(exhibit_of("locus").look.depth, anchors.LAYERS, 0)
    titles = [axis.get_title(loc="left") for axis in axes]
    assert titles == ["start", *(f"after layer {n}" for n in layers[1:]), titles[-1]]
    assert "Not shown: tokengs" in made.caption
    assert len(pictures(axes)) == len(axes) == len(layers) + 1
    with pytest.raises(NothingToShowError, match="tokengs: the queries have no anchors"):
        anchors.anchors(exhibition_of("tokengs"))


def test_attention_is_that_of_a_trace_and_its_anchor_lies_where_it_was() -> None:
    shown, (query, layer) = exhibit_of("locus"), (5, 2)
    with torch.no_grad(), qgs.trace(shown.model, [layer], [query]) as record:
        shown.model(shown.sample.inputs)
    traced = record.layers[layer].cross_attention
    assert traced is not None
    assert record.grid is not None
    for part in attention.PARTS:
        found = attention.part_maps(shown, shown.look.attention(query, layer), part)
        expected = getattr(traced, part)[0, :, 0].mean(0).view(record.grid)
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
    axes = attention.cross_attention(exhibition_of(*PAIR, query=query)).figure.axes
    assert words(axes) == ["none"] * len(chosen_layers(shown.look.depth, attention.CROSS_LAYERS))
    dots = [line for axis in axes for line in axis.lines if line.get_marker() == "o"]
    drawn = np.array([np.concatenate([d.get_xdata(), d.get_ydata()]) for d in dots])
    camera = shown.sample.inputs.cameras[:, :1].to(torch.float64)
    for chosen in chosen_layers(shown.look.depth, attention.CROSS_LAYERS):
        support = shown.look.support(chosen - 1)
        assert support is not None
        local = to_camera(support.centers[:, [query]], camera)[0, 0]
        pixel = to_pixels(local, camera.intrinsics[0, 0])[0] * attention.PHOTO / SIDE - 0.5
        there = (np.abs(drawn - pixel.numpy()) < 1e-2).all(1)
        assert there.sum() == len(attention.PARTS)


@pytest.mark.parametrize("kind", [*PAIR, "landmark"])  # its layers differ
def test_edges_lead_to_the_queries_that_are_read_most(kind: str) -> None:
    shown, (query, layer) = exhibit_of(kind), (5, exhibit_of(kind).look.depth)
    with torch.no_grad(), qgs.trace(shown.model, [layer], [query]) as record:
        shown.model(shown.sample.inputs)
    traced = record.layers[layer].self_attention
    assert traced is not None
    shares = traced.weights[0, :, 0].mean(0)
    order = [i for i in shares.argsort(descending=True).tolist() if i != query][: attention.EDGES]
    found, relative = attention.strongest_edges(shown, query, layer, "weights")
    assert found.tolist() == order
    torch.testing.assert_close(relative, shares[order] / shares[order[0]], rtol=1e-4, atol=1e-6)
    axis = attention.self_attention(exhibition_of(kind, query=query)).figure.axes[-1]
    (edges,) = (c for c in axis.collections if isinstance(c, LineCollection))
    nodes = attention.nodes_of(shown, layer)
    places = plan_of(shown, attention.nodes_of(shown, shown.look.depth)).of(nodes).numpy()
    expected = [[places[query], places[other]] for other in order]
    np.testing.assert_allclose(edges.get_segments(), expected, atol=1e-9)


def test_files_are_of_the_width_of_a_page_with_text_and_the_same_each_time(tmp_path: Path) -> None:
    figure = new_figure(1.0)
    figure.subplots().set_title("a title")
    for name in ("a", "b"):
        write_figure(figure, tmp_path, name)
    for kind in ("pdf", "png"):
        assert (tmp_path / f"a.{kind}").read_bytes() == (tmp_path / f"b.{kind}").read_bytes()
    assert b"/FontFile2" in (tmp_path / "a.pdf").read_bytes()
    assert b"/Type3" not in (tmp_path / "a.pdf").read_bytes()
    assert Image.open(tmp_path / "a.png").width == round(WIDTH * DPI)
