"""What the figures draw, in numbers, with small untrained models; `qgs figures`."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from commands import done
from matplotlib.collections import LineCollection
from numpy.testing import assert_allclose
from PIL import Image
from qgs_viewer.figures import anchors, attention, dispersion, novel_views
from qgs_viewer.figures.command import NAMES
from qgs_viewer.figures.exhibits import NothingToShowError
from qgs_viewer.figures.gallery import FIGURES, open_exhibition
from qgs_viewer.figures.outside import plan_of
from qgs_viewer.figures.paper import DPI, WIDTH, chosen_layers, new_figure, write_figure
from qgs_viewer.pictures import error_picture
from small import PAIR, QUERIES, SIDE, exhibit_of, exhibition_of, model_of

import qgs
from qgs.contracts import MetricInput
from qgs.drawing.images import depth_picture, depth_range, rgb_picture
from qgs.geometry.transforms import to_camera, to_pixels
from qgs.metrics import Dispersion


def titles(made):
    return [axis.get_title(loc="left") for axis in made.figure.axes]


def pictures(made):
    """What the panels show that show a picture."""
    return [np.asarray(axis.images[0].get_array()) for axis in made.figure.axes if axis.images]


def words(*axes):
    return [text.get_text() for axis in axes for text in axis.texts]


@torch.no_grad()
def seen_by(model, sample):
    """Render, error and depth of the middle target, and the photo."""
    rendering = model.render(model(sample.inputs).gaussians, sample.targets.cameras[:, 1:2])
    image = rendering.rgb[0, 0].clamp(0, 1)
    truth = sample.targets.images[0, 1]
    return image, (image - truth).abs().mean(0, keepdim=True), rendering.depth[0, 0], truth


def test_novel_views_show_the_middle_target_with_its_score_error_and_depths_on_one_scale():
    show = exhibition_of(*PAIR)
    true = torch.linspace(1, 9, 2 * SIDE * SIDE).view(2, 1, SIDE, SIDE)
    first, second = show.samples
    known = replace(first, targets=replace(first.targets, depths=true[None]))
    made = novel_views.made(replace(show, samples=[known, second]))
    axes = made.figure.axes
    seen = [seen_by(model, sample) for sample in show.samples for model in show.models.values()]
    own = seen[:2]
    brightest = depth_range(torch.stack([error for _, error, _, _ in seen]))[1]
    near, far = depth_range(torch.cat([true[1], *(depth for _, _, depth, _ in own)]))
    expected = [rgb_picture(first.inputs.images[0, 1]), depth_picture(true[1], near, far)]
    for image, error, depth, truth in own:
        score = -10 * (image - truth).square().mean().log10()
        assert f"{score:.2f} dB" in words(*axes)
        expected += [rgb_picture(image), rgb_picture(truth), error_picture(error, brightest)]
        expected.append(depth_picture(depth, near, far))
    shown = pictures(made)
    assert all(any(np.array_equal(one, other) for other in shown) for one in expected)
    assert words(axes[titles(made).index("true depth")]) == [f"{near:.2g} to {far:.2g}"]
    assert "the true depth, which is shown" in made.caption
    unknown = novel_views.made(show)
    assert "true depth" not in "".join([unknown.caption, *titles(unknown)])


def test_bars_are_the_metric_of_each_scene():
    show = exhibition_of(*PAIR)
    metric = Dispersion(Dispersion.Config())
    axes = dispersion.made(show).figure.axes
    for number, model in enumerate(show.models.values()):
        expected = []
        for sample in show.samples:
            views = sample.targets
            with torch.no_grad():
                gaussians = model(sample.inputs).gaussians
            given = MetricInput(views.images, views, gaussians, gaussians.count // QUERIES)
            expected.append([metric(given)[name].mean() for name in ("mean", "median")])
        for axis, values in zip(axes, np.transpose(expected), strict=True):
            heights = [bar.get_height() for bar in axis.containers[number]]
            assert_allclose(heights, values, rtol=1e-5)
            assert_allclose(axis.lines[number].get_ydata(), values.mean(), rtol=1e-5)


def test_anchors_are_shown_layer_by_layer_of_models_that_have_them():
    made = anchors.anchors(exhibition_of(*PAIR))
    layers = chosen_layers(exhibit_of("locus").look.depth, anchors.LAYERS, 0)
    assert titles(made)[:-1] == ["start", *(f"after layer {n}" for n in layers[1:])]
    assert "Not shown: tokengs" in made.caption
    with pytest.raises(NothingToShowError, match="tokengs: the queries have no anchors"):
        anchors.anchors(exhibition_of("tokengs"))


def test_an_anchor_lies_where_it_was_when_its_query_read():
    shown, query = exhibit_of("locus"), 5
    axes = attention.cross_attention(exhibition_of(*PAIR, query=query)).figure.axes
    layers = chosen_layers(shown.look.depth, attention.CROSS_LAYERS)
    assert words(*axes) == ["none"] * len(layers)  # the geometry of TokenGS
    dots = [line for axis in axes for line in axis.lines if line.get_marker() == "o"]
    drawn = np.array([dot.get_xydata()[0] for dot in dots])
    camera = shown.sample.inputs.cameras[:, :1].to(torch.float64)
    for layer in layers:
        center = shown.look.support(layer - 1).centers[:, [query]]
        pixel = to_pixels(to_camera(center, camera)[0, 0], camera.intrinsics[0, 0])
        there = abs(drawn - (pixel * attention.PHOTO / SIDE - 0.5).numpy()) < 1e-2
        assert there.all(1).sum() == len(attention.PARTS)


@pytest.mark.parametrize("kind", ["locus", "landmark"])  # whose layers differ
def test_edges_lead_to_the_queries_that_are_read_most(kind):
    shown, query = exhibit_of(kind), 5
    last = shown.look.depth
    shares = shown.look.self_attention(query, last).weights[0, :, 0].mean(0)
    order = [other for other in shares.argsort(descending=True).tolist() if other != query]
    order = order[: attention.EDGES]
    found, relative = attention.strongest_edges(shown, query, last, "weights")
    assert found.tolist() == order
    assert_allclose(relative, shares[order] / shares[order[0]], rtol=1e-4)
    axis = attention.self_attention(exhibition_of(kind, query=query)).figure.axes[-1]
    (edges,) = (lines for lines in axis.collections if isinstance(lines, LineCollection))
    nodes = attention.nodes_of(shown, last)
    places = plan_of(shown, nodes).of(nodes).numpy()
    expected = [[places[query], places[other]] for other in order]
    assert_allclose(edges.get_segments(), expected, atol=1e-9)


def test_files_are_of_the_width_of_a_page_with_text_and_the_same_each_time(tmp_path):
    figure = new_figure(1.0)
    figure.subplots().set_title("a title")
    for name in ("a", "b"):
        write_figure(figure, tmp_path, name)
    for kind in ("pdf", "png"):
        assert (tmp_path / f"a.{kind}").read_bytes() == (tmp_path / f"b.{kind}").read_bytes()
    text = (tmp_path / "a.pdf").read_bytes()
    assert b"/FontFile2" in text
    assert b"/CreationDate" not in text  # a second later it would be another
    assert Image.open(tmp_path / "a.png").width == round(WIDTH * DPI)


@pytest.fixture
def checkpoint(tmp_path):
    """An untrained LocusGS with two test rooms."""
    file = tmp_path / "small.safetensors"
    data = ("data.image_size=[16, 16]", "data.test_scenes=2", "evaluation.scenes=2")
    qgs.save(model_of("locus", *data), file)
    return file


def test_figures_are_written_and_explained(checkpoint, tmp_path):
    out = tmp_path / "figures"
    words = ["figures", checkpoint, "--out", out, "--device", "cpu"]
    done(*words, "--only", "dispersion", "--only", "curves")
    written = {"dispersion.pdf", "dispersion.png", "figures.md"}
    assert {file.name for file in out.iterdir()} == written
    assert "![dispersion](dispersion.png)" in (out / "figures.md").read_text()
    assert tuple(FIGURES) == NAMES
    with pytest.raises(FileExistsError):
        done(*words)


def test_the_scene_that_was_asked_for_comes_first(checkpoint):
    show = open_exhibition([str(checkpoint)], scene="test/000001")
    assert [sample.scene for sample in show.samples] == ["test/000001", "test/000000"]
    assert show.exhibits[0].sample.scene == "test/000001"


@pytest.mark.slow
def test_all_figures_of_the_models_in_the_box(tmp_path):
    out = tmp_path / "figures"
    done("figures", "rooms/tokengs-64", "rooms/locus-64", "--out", out)
    assert {file.stem for file in out.glob("*.pdf")} == {*FIGURES}
