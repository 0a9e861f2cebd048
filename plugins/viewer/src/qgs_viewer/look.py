"""Style of pages and figures: colours, Jinja templates, pictures embedded in pages."""

import base64
from collections.abc import Sequence
from io import BytesIO

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from PIL import Image, ImageOps

from qgs.drawing.images import Picture

Color = tuple[int, int, int]

CATEGORICAL = (
    (213, 94, 0),
    (0, 114, 178),
    (0, 158, 115),
    (204, 121, 167),
    (230, 159, 0),
    (86, 180, 233),
)
"""RGB colours that colour-blind readers can tell apart, on white and on photos."""

INK = (32, 36, 42)
MUTED = (122, 128, 136)
# Pixels on the longer side up to which photos in pages are not compressed with loss.
EXACT = 128


def hex_color(color: Color) -> str:
    """Return an RGB colour as text for HTML: #rrggbb."""
    return f"#{bytes(color).hex()}"


def categorical(index: int) -> Color:
    """Return a colour from a palette of six RGB colours; index 6 is the first colour again."""
    return CATEGORICAL[index % len(CATEGORICAL)]


def running_mean(values: Sequence[float]) -> np.ndarray:
    """Return the running mean of `values`, one mean for each value.

    The window is centred and covers a twentieth of the values; at both ends it is cut off.
    """
    # an odd number, so that the window has a middle
    window = np.ones(2 * int(len(values) / 40) + 1)
    sums = np.convolve(values, window, "same")
    return sums / np.convolve(np.ones(len(values)), window, "same")


def page_environment() -> Environment:
    """Return a Jinja environment for the templates of this plug-in, with filters uri and hex."""
    environment = Environment(
        loader=PackageLoader("qgs_viewer", "template"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"uri": data_uri, "hex": hex_color}
    return environment


def data_uri(image: Picture, photo: bool = False) -> str:
    """Return a picture as a data URI for HTML: WebP for a large `photo`, otherwise PNG."""
    kind = "webp" if photo and max(image.shape) > EXACT else "png"
    buffer = BytesIO()
    # PNG has no loss, and no use for these options
    Image.fromarray(image).save(buffer, kind, quality=90, method=2)
    return f"data:image/{kind};base64,{base64.b64encode(buffer.getvalue()).decode()}"


def enlarged(picture: Picture, side: int) -> Picture:
    """Resize a picture (bicubic) so that its longer side has `side` pixels."""
    image = Image.fromarray(picture)
    return np.asarray(ImageOps.scale(image, side / max(image.size)))
