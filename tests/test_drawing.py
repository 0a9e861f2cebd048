"""Pictures of tensors keep what they show, and pages hold them."""

import torch

from qgs.drawing.images import NOTHING, depth_picture, depth_range, rgb_picture


def test_depth_pictures_share_a_scale_and_show_where_nothing_is():
    depth = torch.tensor([[[0.0, 1.0], [2.0, 3.0]]])
    assert abs(depth_range(depth)[0] - 1) <= 0.1
    picture = depth_picture(depth, 1.0, 3.0)
    assert tuple(picture[0, 0]) == NOTHING
    brightness = picture.sum(-1).ravel()
    assert brightness[1] > brightness[2] > brightness[3]
    assert depth_range(torch.zeros(1, 2, 2)) == (0.0, 1.0)


def test_pictures_keep_their_pixels():
    image = torch.rand(3, 4, 6)
    assert abs(rgb_picture(image) / 255 - image.permute(1, 2, 0).numpy()).max() < 0.51 / 255
