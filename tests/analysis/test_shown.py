"""What models, containers and reconstructions look like when printed, and in a notebook."""

import re
from io import BytesIO
from itertools import combinations
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
from PIL import Image

import qgs
from qgs.composer import resolve
from qgs.types import Cameras, GaussianAttributes, Gaussians, Views

SMALL = {
    "recipe": 1,
    "plugins": ["locus"],
    "model": {
        "width": 32,
        "heads": 2,
        "queries": {"type": "locus/anchored", "count": 8},
        "decoder": {
            "depth": 2,
            "layers": {"1": {"cross_attention": {"type": "locus/ray_biased"}}},
        },
        "head": {"gaussians_per_query": 4},
        "supervision": {"layers": [2]},
    },
}


SPACE = "{http://www.w3.org/2000/svg}"


@pytest.fixture(scope="module")
def model():
    return qgs.compose(SMALL).eval()


def views(distance: float = 0.2) -> Views:
    c2w = torch.eye(4).repeat(1, 2, 1, 1)
    c2w[:, 1, 0, 3] = distance
    intrinsics = torch.tensor([20.0, 20.0, 16.0, 16.0]).expand(1, 2, 4)
    generator = torch.Generator().manual_seed(0)
    return Views(
        torch.rand(1, 2, 3, 32, 32, generator=generator), Cameras(c2w, intrinsics, (32, 32))
    )


def test_a_model_says_its_slots_in_a_few_lines(model):
    heading, *lines = repr(model).splitlines()
    total = sum(parameter.numel() for parameter in model.parameters())
    assert f"{total:,} parameters" in heading
    assert "8 queries of 4 Gaussians" in heading
    assert len(lines) == 11
    assert re.search(
        r"^  decoder\.cross_attention +qgs/content, locus/ray_biased +[\d,]+$", repr(model), re.M
    )
    counts = [int(line.split()[-1].replace(",", "")) for line in lines[:9]]
    assert sum(counts) == total
    for word in ("locus/anchored", "qgs/gaussian_head", "qgs/auto"):
        assert word in repr(model)
        assert f"<td>{word}</td>" in model._repr_html_()


@pytest.mark.parametrize("known", [True, False])
def test_a_notebook_shows_the_way_from_views_to_gaussians(model, known):
    shown = model if known else qgs.compose(SMALL)
    shown.recipe = shown.recipe if known else None
    html = shown._repr_html_()
    svg = picture_in(html)
    texts = [element.text or "" for element in svg.iter(f"{SPACE}text")]
    starts = ["views", "encoder: ", "queries: ", "2 decoder layers", "head: ", "Gaussians"]
    found = [text for text in texts if text.startswith(tuple(starts))]
    assert [text.startswith(start) for text, start in zip(found, starts, strict=True)] == [True] * 6
    assert ("encoder: qgs/multiview_vit" in texts) == known
    read = "qgs/content, locus/ray_biased" if known else "ContentCrossAttention, RayBiased"
    assert any(text.startswith(f"cross_attention: {read}") for text in texts)
    counts = [int(t.split()[0].replace(",", "")) for t in texts if t.endswith(" parameters")]
    assert sum(counts) == sum(parameter.numel() for parameter in model.parameters())
    assert_tidy(svg)
    assert len(list(svg.iter(f"{SPACE}path"))) == 5, "arrows"
    assert "#" not in html[: html.index("<table>")], "it takes the colours of its page"


def test_queries_made_of_photos_without_decoder_layers_are_drawn_so():
    pytest.importorskip("qgs_gslrm")
    recipe = resolve(Path(__file__).parents[2] / "recipes" / "tiny" / "gslrm.yaml")
    svg = picture_in(recipe.build_model("meta")._repr_html_())
    assert_tidy(svg)
    assert len(list(svg.iter(f"{SPACE}path"))) == 6, "an arrow to the queries too"


def picture_in(html):
    return ElementTree.fromstring(html[html.index("<svg") : html.index("</svg>") + 6])


def assert_tidy(svg):
    """Boxes lie in the picture and apart, and every line of text in one of them."""
    boxes = [
        [float(element.attrib[name]) for name in ("x", "y", "width", "height")]
        for element in svg.iter(f"{SPACE}rect")
    ]
    for a, b in combinations(boxes, 2):
        assert any(a[i] + a[i + 2] < b[i] or b[i] + b[i + 2] < a[i] for i in (0, 1)), (a, b)
    wide, high = (float(end) for end in svg.attrib["viewBox"].split()[2:])
    for x, y, width, height in boxes:
        assert 0 < x < x + width < wide
        assert 0 < y < y + height < high
    for text in svg.iter(f"{SPACE}text"):
        x, y = float(text.attrib["x"]), float(text.attrib["y"])
        end = x + 6.62 * len(text.text or "")  # of 11 pixels, as monospaced letters are
        holding = [b for b in boxes if b[0] < x < end < b[0] + b[2] and b[1] < y < b[1] + b[3]]
        assert len(holding) == 1, text.text


def test_a_model_built_by_hand_is_told_by_its_classes(model):
    model = qgs.compose(SMALL)
    model.recipe = None
    assert re.search(r"^  head +GaussianHead ", repr(model), re.M)


def test_containers_tell_shapes_and_no_numbers(model):
    prediction = model(views(), layers=[1])
    text = repr(prediction)
    assert len(text) < 400
    assert "means: (1, 32, 3)" in text
    assert "fields: {anchor.center: (1, 8, 3), anchor.raw_radius: (1, 8, 1)}" in text
    assert "layers: {1: LayerPrediction, 2: LayerPrediction}" in text
    assert (
        repr(views().cameras) == "Cameras(c2w: (1, 2, 4, 4), intrinsics: (1, 2, 4), size: (32, 32))"
    )
    assert repr(views()).splitlines()[1:] == [
        "  images: (1, 2, 3, 32, 32)",
        f"  cameras: {views().cameras!r}",
        "  masks: None",
        "  times: None",
        "  target_time: None",
        ")",
    ]
    assert "c2w: (1, 2, 4, 4) float64" in repr(views().cameras.to(torch.float64))
    assert "float32" not in text
    assert "c2w: (1, 2, 4, 4) meta" in repr(views().cameras.to("meta"))
    attributes = GaussianAttributes(
        *(torch.zeros(1, 2, 4, n) for n in (3, 3, 4)),
        *[torch.zeros(1, 2, 4)],
        torch.zeros(1, 2, 4, 3),
    )
    assert repr(attributes).startswith("GaussianAttributes(offsets: (1, 2, 4, 3), ")


def gaussians_at(z: float) -> Gaussians:
    """A red and a green one, left and right of the axis."""
    return Gaussians(
        torch.tensor([[[-0.5, 0.0, z], [0.5, 0.0, z]]]),
        torch.full((1, 2, 3), 0.1),
        torch.tensor([1.0, 0, 0, 0]).expand(1, 2, 4),
        torch.full((1, 2), 0.99),
        torch.tensor([[[1.0, 0, 0], [0, 1.0, 0]]]),
    )


def test_a_prediction_shows_its_picture_where_something_lies_before_the_origin(model):
    prediction = model(views())
    seen = type(prediction)(gaussians_at(1.0), prediction.state, {})
    picture = np.asarray(Image.open(BytesIO(seen._repr_png_())))[:, :192].astype(int)
    red = np.argwhere((picture[..., 0] > 150) & (picture[..., 1] < 80))
    green = np.argwhere((picture[..., 1] > 150) & (picture[..., 0] < 80))
    assert len(red) > 20
    assert len(green) > 20
    assert red[:, 1].max() < 96 < green[:, 1].min()
    behind = type(prediction)(gaussians_at(-1.0), prediction.state, {})
    assert behind._repr_png_() is None
    assert prediction.to("meta")._repr_png_() is None
