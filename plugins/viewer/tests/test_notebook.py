"""Pictures of models and predictions in a notebook."""

import re
from dataclasses import replace
from io import BytesIO

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
    mixed = "model.decoder.layers.0.cross_attention.type=qgs/content"
    model = qgs.compose("tiny/locus.yaml", [mixed])
    model.recipe = model.recipe if known else None
    html = model._repr_html_()
    boxes = html[: html.index("<table>")]
    texts = re.findall(r"<div>(.*?)</div>", boxes)
    starts = ("views", "encoder: ", "queries: ", f"{model.depth} decoder", "head: ", "Gaussians")
    places = [next(i for i, text in enumerate(texts) if text.startswith(s)) for s in starts]
    assert places == sorted(places)
    assert ("encoder: qgs/multiview_vit" in texts) == known
    read = "qgs/content, locus/ray_biased" if known else "ContentCrossAttention, RayBiased"
    assert any(text.startswith(f"cross_attention: {read}") for text in texts)
    counts = [int(t.split()[0].replace(",", "")) for t in texts if t.endswith(" parameters")]
    assert sum(counts) == sum(parameter.numel() for parameter in model.parameters())
    # learned queries have no arrow, and the box takes the colours of its page
    assert boxes.count("→") == len(re.findall("border:", boxes)) - 2
    assert "#" not in boxes


def test_a_prediction_shows_its_picture_where_something_lies_before_the_origin():
    """A red and a green Gaussian, left and right of the axis."""
    prediction = model_of("tokengs")(sample_of().inputs)
    means = torch.tensor([[[-0.5, 0.0, 1.0], [0.5, 0.0, 1.0]]])
    colors = torch.eye(3)[None, :2]
    two = replace(cloud(2), means=means, opacities=torch.full((1, 2), 0.99), colors=colors)
    png = replace(prediction, gaussians=two)._repr_png_()
    picture = np.asarray(Image.open(BytesIO(png)))[:, :192].astype(int)
    redder = picture[..., 0] - picture[..., 1]
    red = np.nonzero(redder > 70)[1]
    green = np.nonzero(redder < -70)[1]
    assert red.max() < 96 < green.min()
    assert prediction_png(replace(prediction, gaussians=replace(two, means=-means))) is None
    assert prediction_png(prediction.to("meta")) is None
