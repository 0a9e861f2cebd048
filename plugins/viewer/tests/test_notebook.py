"""Pictures of models and predictions in a notebook."""

from io import BytesIO
from itertools import combinations
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
from PIL import Image
from qgs_viewer.notebook import prediction_png, show_pictures
from small import model_of, sample_of

import qgs
from qgs.types import Gaussians

SPACE = "{http://www.w3.org/2000/svg}"

show_pictures()


@pytest.mark.parametrize("known", [True, False])
def test_a_model_shows_the_way_from_views_to_gaussians(known):
    overrides = ["model.decoder.layers={0: {cross_attention: {type: qgs/content}}}"]
    model = qgs.compose("recipes/tiny/locus.yaml", overrides)
    model.recipe = model.recipe if known else None
    html = model._repr_html_()
    svg = picture_in(html)
    texts = [element.text or "" for element in svg.iter(f"{SPACE}text")]
    starts = ["views", "encoder: ", "queries: ", f"{model.depth} decoder", "head: ", "Gaussians"]
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


def gaussians_at(z: float) -> Gaussians:
    """A red and a green one, left and right of the axis."""
    return Gaussians(
        torch.tensor([[[-0.5, 0.0, z], [0.5, 0.0, z]]]),
        torch.full((1, 2, 3), 0.1),
        torch.tensor([1.0, 0, 0, 0]).expand(1, 2, 4),
        torch.full((1, 2), 0.99),
        torch.tensor([[[1.0, 0, 0], [0, 1.0, 0]]]),
    )


def test_a_prediction_shows_its_picture_where_something_lies_before_the_origin():
    prediction = model_of("tokengs")(sample_of().inputs)
    seen = type(prediction)(gaussians_at(1.0), prediction.state, {})
    picture = np.asarray(Image.open(BytesIO(seen._repr_png_())))[:, :192].astype(int)
    red = np.argwhere((picture[..., 0] > 150) & (picture[..., 1] < 80))
    green = np.argwhere((picture[..., 1] > 150) & (picture[..., 0] < 80))
    assert min(len(red), len(green)) > 20
    assert red[:, 1].max() < 96 < green[:, 1].min()
    behind = type(prediction)(gaussians_at(-1.0), prediction.state, {})
    assert prediction_png(behind) is None
    assert prediction_png(prediction.to("meta")) is None
