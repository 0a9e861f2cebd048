"""Pictures of models and predictions in a notebook."""

from dataclasses import replace
from io import BytesIO
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
from PIL import Image
from qgs_viewer.notebook import prediction_png, show_pictures
from small import cloud, model_of, sample_of

import qgs

show_pictures()


@pytest.mark.parametrize("known", [True, False])
def test_a_model_shows_the_way_from_views_to_gaussians(known):
    model = qgs.compose(
        "tiny/locus.yaml", ["model.decoder.layers.0.cross_attention.type=qgs/content"]
    )
    model.recipe = model.recipe if known else None
    html = model._repr_html_()
    svg = ElementTree.fromstring(html[html.index("<svg") : html.index("</svg>") + 6])
    texts = [element.text or "" for element in svg.iterfind("{*}text")]
    starts = ("views", "encoder: ", "queries: ", f"{model.depth} decoder", "head: ", "Gaussians")
    places = [next(i for i, text in enumerate(texts) if text.startswith(s)) for s in starts]
    assert places == sorted(places)
    assert ("encoder: qgs/multiview_vit" in texts) == known
    read = "qgs/content, locus/ray_biased" if known else "ContentCrossAttention, RayBiased"
    assert any(text.startswith(f"cross_attention: {read}") for text in texts)
    counts = [int(t.split()[0].replace(",", "")) for t in texts if t.endswith(" parameters")]
    assert sum(counts) == sum(parameter.numel() for parameter in model.parameters())
    assert_tidy(svg)
    assert "#" not in html[: html.index("<table>")]  # it takes the colours of its page


def assert_tidy(svg):
    """Boxes lie in the picture and apart, and every line of text begins in one of them."""

    def numbers(kind, *names):
        found = [[float(element.get(name)) for name in names] for element in svg.iterfind(kind)]
        return np.array(found)[:, None]

    low = numbers("{*}rect", "x", "y")
    high = low + numbers("{*}rect", "width", "height")
    _, _, *size = map(float, svg.get("viewBox").split())
    assert ((low > 0) & (high < size)).all()
    meet = (low < high[:, 0]) & (low[:, 0] < high)
    assert meet.all(-1).sum() == len(low)  # each with itself
    start = numbers("{*}text", "x", "y")
    assert ((low[:, 0] < start) & (start < high[:, 0])).all(-1).any(1).all()


def test_a_prediction_shows_its_picture_where_something_lies_before_the_origin():
    """A red and a green Gaussian, left and right of the axis."""
    prediction = model_of("tokengs")(sample_of().inputs)
    means = torch.tensor([[[-0.5, 0.0, 1.0], [0.5, 0.0, 1.0]]])
    colors = torch.eye(3)[None, :2]
    two = replace(cloud(2), means=means, opacities=torch.full((1, 2), 0.99), colors=colors)
    png = replace(prediction, gaussians=two)._repr_png_()
    picture = np.asarray(Image.open(BytesIO(png)))[:, :192].astype(int)
    redder = picture[..., 0] - picture[..., 1]
    red, green = np.nonzero(redder > 70)[1], np.nonzero(redder < -70)[1]
    assert red.max() < 96 < green.min()
    assert prediction_png(replace(prediction, gaussians=replace(two, means=-means))) is None
    assert prediction_png(prediction.to("meta")) is None
