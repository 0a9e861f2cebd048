"""`qgs figures`: what stands in the panels, and the files."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from commands import done
from PIL import Image
from qgs_viewer.figures import DPI, FIGURES, WIDTH, grid, write_figure
from qgs_viewer.options import FigureName
from qgs_viewer.pictures import attention_pictures_of, error_picture
from qgs_viewer.sections import Detail, anchors, attention, novel_views
from small import PAIR, QUERIES, model_of, model_scenes_of
from walk import SIDE

import qgs
from qgs.drawing.images import depth_picture, depth_range, rgb_picture, side_by_side


@torch.no_grad()
def test_novel_views_show_the_middle_target_with_its_score_error_and_depths_on_one_scale():
    models = [model_scenes_of(kind) for kind in PAIR]
    true = torch.linspace(1, 9, 2 * SIDE * SIDE).view(1, 2, 1, SIDE, SIDE)
    first, second = models[0].samples
    known = replace(first, targets=replace(first.targets, depths=true))
    models[0] = replace(models[0], samples=[known, second])
    rows = novel_views(models, Detail()).rows
    assert [*rows] == [f"{place}: walk, {kind}" for place in (1, 2) for kind in PAIR]
    truth = first.targets.images[0, 1]
    camera = first.targets.cameras[:, 1:2]
    renders = [model.network.render(model.gaussians[0], camera) for model in models]
    images = [render.rgb[0, 0].clamp(0, 1) for render in renders]
    errors = [(image - truth).abs().mean(0, keepdim=True) for image in images]
    depths = [render.depth[0, 0] for render in renders]
    most = depth_range(torch.stack(errors))[1]
    near, far = depth_range(torch.cat([true[0, 1], *depths]))
    # the rows of other models do not repeat what all share
    shared = [rgb_picture(truth), depth_picture(true[0, 1], near, far)]
    for row, image, error, depth in zip([*rows.values()][:2], images, errors, depths, strict=True):
        own = [rgb_picture(image), error_picture(error, most), depth_picture(depth, near, far)]
        pictures = [tile.image for tile in row[1:] if tile]
        assert [*map(np.array_equal, pictures, shared + own)] == [True] * len(shared + own)
        assert len(pictures) == len(shared + own)
        score = -10 * (image - truth).square().mean().log10()
        assert row[3].caption == f"render, {score:.2f} dB"
        shared = []


def test_anchors_are_shown_layer_by_layer_of_models_that_have_them():
    rows = anchors([model_scenes_of(kind) for kind in PAIR], Detail(layers=2)).rows
    depth = model_scenes_of("locus").scene.depth
    captions = {name: [tile.caption for tile in tiles] for name, tiles in rows.items()}
    assert captions["locus"][0] == "learned start"
    assert captions["locus"][-1] == f"after layer {depth}"
    assert [*captions] == ["locus"]
    assert not anchors([model_scenes_of("tokengs")], Detail()).rows


def test_attention_is_that_of_the_query_that_was_asked_for():
    models = [model_scenes_of(kind) for kind in PAIR]
    rows = attention(models, Detail(layers=2, query=5)).rows
    depth = models[0].scene.depth
    assert [*rows] == [f"{kind}, query 5, layer {n}" for kind in PAIR for n in (1, depth)]
    assert [tile is None for tile in rows["tokengs, query 5, layer 1"]] == [False, True, False]
    found = attention_pictures_of(models[1].scene, 5, depth, Detail.side // 2)
    drawn = [tile.image for tile in rows[f"locus, query 5, layer {depth}"]]
    for picture, part in zip(drawn, ("content", "geometry", "result"), strict=True):
        assert np.array_equal(picture, side_by_side(found[part]))


def test_files_are_of_the_width_of_a_page_with_text_and_the_same_each_time(tmp_path):
    figure = grid(attention([model_scenes_of("locus")], Detail(side=32)))
    shown = [np.asarray(axis.images[0].get_array()).shape[0] for axis in figure.axes]
    assert shown == [16] * 3
    for name in ("a", "b"):
        write_figure(figure, tmp_path, name)
    for kind in ("pdf", "png"):
        assert (tmp_path / f"a.{kind}").read_bytes() == (tmp_path / f"b.{kind}").read_bytes()
    text = (tmp_path / "a.pdf").read_bytes()
    assert b"/FontFile2" in text
    # a second later it would be another
    assert b"/CreationDate" not in text
    assert Image.open(tmp_path / "a.png").width == round(WIDTH * DPI)


def test_figures_are_written_and_explained(tmp_path):
    model = tmp_path / "small.safetensors"
    rooms = ("data.image_size=[16, 16]", "data.test_scenes=2", "evaluation.scenes=2")
    qgs.save(model_of("locus", *rooms), model)
    words = ["figures", model, "--device", "cpu", "--scene", "test/000001"]
    out = tmp_path / "figures"
    done(*words, "--out", out, "--only", "queries", "--only", "curves")
    assert {file.name for file in out.iterdir()} == {"queries.pdf", "queries.png", "figures.md"}
    text = (out / "figures.md").read_text()
    assert "![queries](queries.png)" in text
    assert "curves is left out" in text
    assert "test/000001" in text
    assert [*FIGURES] == [*FigureName]
    for wrong in (["--out", out], ["--scene", "other"], ["--query", QUERIES]):
        with pytest.raises((ValueError, FileExistsError)):
            done(*words, "--out", tmp_path / "new", *wrong)
    assert not (tmp_path / "new").exists()


@pytest.mark.slow
def test_all_figures_of_the_models_in_the_box(tmp_path):
    out = tmp_path / "figures"
    done("figures", "rooms/tokengs-64", "rooms/locus-64", "--out", out)
    assert {file.stem for file in out.glob("*.pdf")} == {*FIGURES}
