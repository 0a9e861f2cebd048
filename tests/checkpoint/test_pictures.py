import numpy as np
from PIL import Image

from qgs.drawing.images import write_gif, write_png


def test_png_keeps_every_pixel_and_gif_all_frames_in_a_loop(tmp_path):
    picture = np.random.default_rng(0).integers(0, 256, (5, 7, 3), dtype=np.uint8)
    write_png(picture, tmp_path / "a.png")
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "a.png")), picture)
    shades = [np.full((8, 8, 3), shade, np.uint8) for shade in (0, 80, 160, 240)]
    write_gif(shades, tmp_path / "a.gif", frames_per_second=10)
    with Image.open(tmp_path / "a.gif") as gif:
        assert (gif.n_frames, gif.info["loop"], gif.info["duration"]) == (4, 0, 100)
        gif.seek(2)
        assert np.asarray(gif.convert("RGB"))[0, 0].tolist() == [160, 160, 160]
