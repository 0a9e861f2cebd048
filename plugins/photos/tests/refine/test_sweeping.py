"""Points on what photos show, of the inside of a textured box."""

import numpy as np
import torch
from qgs_photos.refine.refining import partly_swept
from qgs_photos.refine.sweeping import swept
from test_refining import cloud, generator
from textured_room import INTRINSICS, SIZE, walk

from qgs.geometry.transforms import to_camera, to_pixels
from qgs.types import Cameras, Views


def photos(count):
    """The first photos (1, V) of a walk."""
    shots = walk(20)[:count]
    images, c2w = (np.stack([getattr(s, name) for s in shots]) for name in ("image", "c2w"))
    images, c2w = torch.tensor(images).movedim(-1, 1) / 255, torch.tensor(c2w).float()
    lens = torch.tensor(INTRINSICS).expand(1, count, 4)
    return Views(images[None], Cameras(c2w[None], lens, SIZE))


def test_points_lie_on_the_walls_in_their_colours():
    """Of two photos and of more; with sizes far from the truth, and more than one batch."""
    for count, size, number in ((2, 1.0, 400), (2, 2.0, 2400), (9, 4.0, 400)):
        views = photos(count)
        found = swept(views, number, size, generator())
        assert found.count == number
        off = (found.means.abs() / torch.tensor([1.2, 1.0, 1.5])).amax(-1) - 1
        assert (off.abs() < 0.075).float().mean() > 0.85  # depths are tried in steps of 7 %
        seen = to_camera(found.means, views.cameras)
        pixels = to_pixels(seen, views.cameras.intrinsics)[0]
        # each is as large as two pixels of the photo that it is of, and has its colour
        sizes = 2 * seen[0, ..., 2] / INTRINSICS[0]
        difference, photo = (sizes - found.scales[0, :, 0]).abs().min(0)
        assert difference.max() < 1e-5
        x, y = pixels[photo, torch.arange(number)].long().T
        alike = (views.images[0, photo, :, y, x] == found.colors[0]).all(-1)
        assert alike.float().mean() > 0.95  # but for those of two photos as far away


def test_without_evidence_the_depth_is_the_size():
    """Of photos that show nothing in common."""
    views = photos(2)
    views.cameras.c2w[0, 1, :3, [0, 2]] *= -1  # turned about
    found = swept(views, 50, 3.0, generator())
    depths = to_camera(found.means, views.cameras)[0, ..., 2].amax(0)  # from the one that shows it
    assert (depths / 3 - 1).abs().max() < 0.04  # half of a step between the depths that are tried


def test_half_makes_room_and_the_most_opaque_stay():
    given = cloud(11)
    views = photos(3)
    mixed = partly_swept(given, views, 9, 0.5, generator())
    assert mixed.count == 9
    assert torch.equal(mixed.means[:, :5], given.most_opaque(5).means)
    alone = partly_swept(given, views.select([1]), 9, 0.5, generator())
    assert torch.equal(alone.means, given.most_opaque(9).means)
