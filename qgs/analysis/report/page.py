"""The page itself: pictures as data URIs, words and tables from the template."""

from __future__ import annotations

import base64
from io import BytesIO
from typing import Any

import torch
from jinja2 import Environment, PackageLoader, StrictUndefined
from PIL import Image

from qgs.analysis.pictures.figures import curves_figure, figure_picture
from qgs.analysis.pictures.palette import hex_color
from qgs.analysis.report import gallery
from qgs.analysis.report.contents import Report
from qgs.io.drawing import Picture
from qgs.io.pictures import png_bytes


@torch.no_grad()
def report_html(report: Report) -> str:
    """The whole page; it needs no other file and no network."""
    environment = Environment(
        loader=PackageLoader("qgs.analysis.report", "template"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(png=png_uri, animation=animation_uri, hex=hex_color)
    return environment.get_template("report.html").render(_contents(report))


def _contents(report: Report) -> dict[str, Any]:
    first = report.samples[0]
    predictions = [
        [(c.name, c.model, c.model(sample.inputs)) for c in report.contenders]
        for sample in report.samples
    ]
    of_first = {name: prediction for name, _, prediction in predictions[0]}
    curves = {contender.name: contender.curves for contender in report.contenders}
    return {
        "report": report,
        "scenes": [
            gallery.scene_gallery(sample, of_sample, depth)
            for sample, of_sample, depth in zip(
                report.samples, predictions, report.depths, strict=True
            )
        ],
        "tokens": [gallery.token_gallery(c, of_first[c.name], first) for c in report.contenders],
        "anchors": {c.name: gallery.anchor_tiles(c, first) for c in report.contenders},
        "attention": {
            c.name: gallery.attention_tiles(c, of_first[c.name], first) for c in report.contenders
        },
        "orbits": {
            c.name: gallery.orbit_frames(c, of_first[c.name], first) for c in report.contenders
        },
        "curves": figure_picture(curves_figure(curves), dpi=144),
    }


def png_uri(picture: Picture) -> str:
    """A picture as a data URI."""
    return "data:image/png;base64," + base64.b64encode(png_bytes(picture)).decode()


def animation_uri(frames: list[Picture], milliseconds: int = 90) -> str:
    """Frames as an endless animated WebP data URI."""
    buffer = BytesIO()
    first, *rest = [Image.fromarray(frame) for frame in frames]
    first.save(
        buffer,
        format="WEBP",
        save_all=True,
        append_images=rest,
        duration=milliseconds,
        loop=0,
        quality=80,
        method=2,
    )
    return "data:image/webp;base64," + base64.b64encode(buffer.getvalue()).decode()
