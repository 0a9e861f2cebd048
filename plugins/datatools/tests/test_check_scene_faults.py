"""Faults that no frame shows by itself are found by what its photos and the other ones share."""

import numpy as np
from photo_formats import encoded
from PIL import Image, ImageDraw
from planted import ALL, INTRINSICS, SIZE

FX, FY, CX, CY = INTRINSICS


def test_faults_of_a_scene(planted, shots):
    two = "frames 1, 4 (images/1.jpg to images/4.jpg): "
    both = planted(f"error: {two}their poses look exchanged*")
    both.poses[[1, 4]] = both.poses[[4, 1]]
    off = planted("warning: frame 3 (images/3.jpg): the pose or the intrinsics do not fit *")
    off.poses[3, 1, 3] += 0.3
    focal = planted(f"error: {ALL}the focal lengths do not fit*")
    focal.camera.update(fl_x=1.3 * FX, fl_y=1.3 * FY)
    planted(f"error: {ALL}cx and cy look exchanged*").camera.update(cx=CY, cy=CX)
    cut = planted(f"error: {ALL}the intrinsics do not fit*")
    cut.camera["w"] -= 45
    bgr = planted(f"warning: {two}red and blue look exchanged: *")
    black = planted("error: frame 2 (images/2.jpg): the image is black*")
    plain = planted(
        "warning: *: the poses are not judged against the photos: too few matches, below 24 in "
        "every pair that was tried: look at the cameras yourself, in the picture that --report "
        "draws"
    )

    def put(room, number, pixels):
        room.files[f"images/{number}.jpg"] = encoded(pixels, "JPEG", quality=92, subsampling=0)

    for number, shot in enumerate(shots):
        put(cut, number, shot.image[:, 45:])
        put(plain, number, 0 * shot.image + np.uint8([20 * number, 30, 90]))
        if number in (1, 4):
            put(bgr, number, shot.image[..., ::-1])
    put(black, 2, 0 * shots[2].image)
    planted.check()


def poster(shot):
    """A mask that is white on a part of the wall at z = 1.5."""
    corners = np.array([[-0.5, -0.4, 1.5], [0.5, -0.4, 1.5], [0.5, 0.4, 1.5], [-0.5, 0.4, 1.5]])
    x, y, z = ((corners - shot.c2w[:3, 3]) @ shot.c2w[:3, :3]).T
    pixels = np.stack([FX * x / z + CX, FY * y / z + CY], -1)
    mask = Image.new("L", SIZE[::-1])
    ImageDraw.Draw(mask).polygon(pixels.flatten().tolist(), fill=255)
    return np.array(mask)


def test_faults_of_masks(planted, shots):
    masks = np.stack([*map(poster, shots)])
    planted().mask(masks)
    planted(f"error: {ALL}the mask is all black*").mask(0 * masks)
    planted(f"warning: {ALL}the mask is all white*").mask(0 * masks + 255)
    planted(f"warning: {ALL}*look inverted*").mask(255 - masks)
    of_next = "warning: frames 0-4 (images/0.jpg to images/4.jpg): the mask fits the next photo *"
    planted(of_next).mask(np.roll(masks, -1, 0))
    for what, mask in (("is all black", 0 * masks[2]), ("looks inverted", 255 - masks[2])):
        one = planted(f"warning: frame 2 (images/2.jpg): the mask {what}*")
        one.mask([*masks[:2], mask, *masks[3:]])
    damaged = planted(
        "error: frame 0 (images/0.jpg): its mask does not exist in masks: add it, or list no mask",
        "error: frame 1 (images/1.jpg): *1.png cannot be read as the mask of a photo*",
    )
    damaged.mask(masks)
    del damaged.files["masks/0.png"]
    damaged.files["masks/1.png"] = b"no image"
    planted.check()
