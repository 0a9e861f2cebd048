"""`qgs figures`: what stands in the panels, and the files."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from commands import done
from PIL import Image
from qgs_viewer.commands import FigureName
from qgs_viewer.figures import DPI, WIDTH, grid, write_figure
from qgs_viewer.queries import attention_pictures_of
from qgs_viewer.sections import LAYERS, Detail, anchors, cross_attention, novel_views
from small import PAIR, QUERIES, model_of, model_scenes_of
from tables import must_refuse, names_in
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
    kinds = ("render", "error", "depth")
    assert [*rows] == [f"{place}: walk, {kind}" for place in (1, 2) for kind in kinds]
    truth = first.targets.images[0, 1]
    camera = first.targets.cameras[:, 1:2]
    renders = [model.network.render(model.gaussians[0], camera) for model in models]
    images = [truth, *(render.rgb[0, 0].clamp(0, 1) for render in renders)]
    depths = [true[0, 1], *(render.depth[0, 0] for render in renders)]
    near, far = depth_range(torch.cat(depths))
    given = [rgb_picture(photo) for photo in first.inputs.images[0]]
    for kind, expected in (
        ("render", [*given, *map(rgb_picture, images)]),
        ("depth", [None, None, *(depth_picture(depth, near, far) for depth in depths)]),
    ):
        found = [tile and tile.image for tile in rows[f"1: walk, {kind}"]]
        assert [*map(np.array_equal, found, expected)] == [True] * 5, kind
    assert [tile is None for tile in rows["1: walk, error"]] == [True] * 3 + [False] * 2
    score = -10 * (images[1] - truth).square().mean().log10()
    assert rows["1: walk, render"][3].caption == f"tokengs {score:.2f} dB"


def test_anchors_are_shown_layer_by_layer_of_models_that_have_them():
    rows = anchors([model_scenes_of(kind) for kind in PAIR], Detail()).rows
    assert [*rows] == ["locus"]
    captions = [tile.caption for tile in rows["locus"]]
    depth = model_scenes_of("locus").scene.depth
    assert captions[0] == "learned start"
    assert captions[-1] == f"after layer {depth}"
    assert len(captions) <= LAYERS + 1


def test_attention_is_that_of_the_query_that_was_asked_for():
    models = [model_scenes_of(kind) for kind in PAIR]
    rows = cross_attention(models, Detail(query=5)).rows
    assert [*rows] == [f"{kind}, query 5" for kind in PAIR]
    assert [tile is None for tile in rows["tokengs, query 5"]] == [False, True, False]
    found = attention_pictures_of(models[1].scene, 5, models[1].scene.depth, Detail.side // 2)
    drawn = [tile.image for tile in rows["locus, query 5"]]
    for picture, part in zip(drawn, ("content", "geometry", "weights"), strict=True):
        assert np.array_equal(picture, side_by_side(found[part]))


def test_files_are_of_the_width_of_a_page_with_text_and_no_date(tmp_path):
    figure = grid(cross_attention([model_scenes_of("locus")], Detail(side=32)))
    assert [np.asarray(axis.images[0].get_array()).shape[0] for axis in figure.axes] == [16] * 3
    write_figure(figure, tmp_path, "a")
    text = (tmp_path / "a.pdf").read_bytes()
    assert b"/FontFile2" in text
    # a second later it would be another
    assert b"/CreationDate" not in text
    assert Image.open(tmp_path / "a.png").width == round(WIDTH * DPI)


def test_figures_are_written_and_explained(tmp_path):
    model = tmp_path / "small.safetensors"
    rooms = ("data.image_size=[16, 16]", "data.test_scenes=2", "evaluation.scenes=2")
    qgs.save(model_of("locus", *rooms), model)
    line = f"figures {model} --device cpu --scene test/000001 --out {tmp_path}"
    out = tmp_path / "figures"
    done(f"{line}/figures --only queries --only curves")
    assert names_in(out) == {"queries.pdf", "queries.png", "figures.md"}
    text = (out / "figures.md").read_text()
    assert "![queries](queries.png)" in text
    assert "curves is left out" in text
    assert "test/000001" in text
    for wrong in (f"--out {out}", "--scene other", f"--query {QUERIES}"):
        must_refuse(None, done, f"{line}/new {wrong}", kind=(ValueError, FileExistsError))
    assert not (tmp_path / "new").exists()


@pytest.mark.slow
def test_all_figures_of_the_models_in_the_box(tmp_path):
    out = tmp_path / "figures"
    done(f"figures rooms/tokengs-64 rooms/locus-64 --out {out}")
    assert {file.stem for file in out.glob("*.pdf")} == {*FigureName}
