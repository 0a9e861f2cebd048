"""Pictures of models and predictions in a notebook."""

import re
from dataclasses import replace
from io import BytesIO

import numpy as np
import torch
from PIL import Image
from qgs_viewer.notebook import prediction_png, show_pictures
from small import cloud, model_of, sample_of

import qgs

show_pictures()


def test_a_model_shows_its_components_and_their_sizes():
    html = qgs.compose("tiny/locus.yaml")._repr_html_()
    cells = re.findall("<td>(.*?)</td>", html)
    assert {"encoder", "qgs/multiview_vit", "locus/ray_biased"} <= {*cells}
    assert "parameters" in html.partition("<table>")[0]


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
    assert prediction_png(prediction.to("meta")) is None
