"""The pictures of README.md and docs/, drawn from trained models.

    python tools/make_pictures.py [--tokengs CHECKPOINT] [--locus CHECKPOINT] [--scene 0]
    python tools/make_pictures.py --rounds CHECKPOINT
    python tools/make_pictures.py --worlds

Writes docs/images/first_sight.webp (a room that no model has seen: the photos, a walk through each
model's Gaussians, LocusGS's anchors) and docs/images/anchors.png (the anchors layer by layer); of a
model with feedback docs/images/landmark_round.webp (a view without and with its rounds); of worlds
docs/images/worlds_scenes.webp (three views of the first ones).
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from qgs_viewer.pictures import color_error, error_picture
from qgs_viewer.queries import notable_queries, support_picture
from qgs_worlds.source import WorldsConfig, WorldsSource

import qgs
from qgs.data.samples import Sample
from qgs.drawing.figures import INK
from qgs.drawing.images import (
    Picture,
    enlarged,
    rgb_picture,
    shaded,
    side_by_side,
    write_png,
)
from qgs.evaluate.plan import evaluation_samples
from qgs.files import replacing
from qgs.metrics.images import psnr
from qgs.model import QueryGaussianModel
from qgs.recipe import resolve
from qgs.reconstruction.saving import orbit_path
from qgs.types import Cameras, Gaussians, Prediction, Views

ROOT = Path(__file__).parents[1]
IMAGES = ROOT / "docs" / "images"
SIDE, GAP, TITLE = 240, 6, 26  # pixels
FRAMES, MILLISECONDS = 48, 80
OUTLINED = 12  # queries whose support is drawn


def titled(pictures: Sequence[Picture], titles: Sequence[str]) -> Picture:
    """Pictures of one height in a row on white, each under its title."""
    widths = [picture.shape[1] for picture in pictures]
    size = sum(widths) + GAP * (len(widths) - 1), pictures[0].shape[0] + TITLE
    canvas = Image.new("RGB", size, "white")
    draw, font, left = ImageDraw.Draw(canvas), ImageFont.load_default(15), 0
    for picture, title, width in zip(pictures, titles, widths, strict=True):
        draw.text((left + width / 2, TITLE / 2), title, INK, font, anchor="mm")
        canvas.paste(Image.fromarray(picture), (left, TITLE))
        left += width + GAP
    return np.asarray(canvas)


def stacked(photos: Sequence[Picture]) -> Picture:
    """Two square pictures one above the other, as high as one of SIDE pixels."""
    side = (SIDE - GAP) // 2
    spacer = np.full((SIDE - 2 * side, side, 3), 255, np.uint8)
    return np.concatenate([enlarged(photos[0], side), spacer, enlarged(photos[-1], side)])


def walk(model: QueryGaussianModel, gaussians: Gaussians, path: Cameras) -> list[Picture]:
    """What the cameras (1, F) of `path` see."""
    rendered = [model.render(gaussians, path[:, i : i + 1]).rgb[0, 0] for i in range(FRAMES)]
    return [enlarged(rgb_picture(image), SIDE) for image in rendered]


def anchors_on(
    model: QueryGaussianModel,
    prediction: Prediction,
    pictures: Sequence[Picture],
    path: Cameras,
    views: Views,
) -> list[Picture]:
    """`pictures` washed out, with the anchors and the supports of OUTLINED queries upon them."""
    chosen = notable_queries(model, prediction.gaussians, views.cameras, OUTLINED)
    colors = {query.index: query.color for query in chosen}
    support = model.queries.support(prediction.state)
    assert support is not None
    return [
        support_picture(picture, support, path[:, i : i + 1], colors)
        for i, picture in enumerate(pictures)
    ]


def write_webp(frames: Sequence[Picture], path: Path) -> None:
    """Write an endless animation, or one picture."""
    first, *rest = map(Image.fromarray, frames)
    options = {"duration": MILLISECONDS, "loop": 0, "quality": 72, "method": 6}
    with replacing(path) as temporary:
        first.save(temporary, "WEBP", save_all=True, append_images=rest, **options)


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description="The pictures of README.md and docs/.")
    parser.add_argument("--tokengs", default="rooms/tokengs-64")
    parser.add_argument("--locus", default="rooms/locus-64")
    parser.add_argument("--rounds", metavar="CHECKPOINT", help="Draw this model's rounds alone.")
    parser.add_argument("--worlds", action="store_true", help="Draw worlds alone.")
    parser.add_argument("--scene", type=int, default=0, help="Number of the test room.")
    arguments = parser.parse_args()
    if arguments.worlds:
        return draw_worlds()
    if arguments.rounds:
        return draw_rounds(qgs.load(arguments.rounds), arguments.scene)
    models = [qgs.load(arguments.tokengs), qgs.load(arguments.locus)]
    sample = test_sample(models[1], arguments.scene)
    predictions: list[Prediction] = [model(sample.inputs) for model in models]
    rendering = models[1].render(predictions[1].gaussians, sample.inputs.cameras)
    path = orbit_path(sample.inputs.cameras, rendering.depth, FRAMES, SIDE)
    walks = [walk(m, p.gaussians, path) for m, p in zip(models, predictions, strict=True)]
    anchors = anchors_on(models[1], predictions[1], walks[1], path, sample.inputs)
    photos = stacked([rgb_picture(image) for image in sample.inputs.images[0]])
    titles = ("2 photos", "TokenGS", "LocusGS", "its anchors")
    frames = [titled([photos, *row], titles) for row in zip(*walks, anchors, strict=True)]
    write_webp(frames, IMAGES / "first_sight.webp")
    write_png(layers_picture(models[1], sample.inputs), IMAGES / "anchors.png")
    for written in (IMAGES / "first_sight.webp", IMAGES / "anchors.png"):
        announce(written)


def announce(path: Path) -> None:
    """Print where a picture is, and how large."""
    print(f"{path.relative_to(ROOT)}: {path.stat().st_size / 1000:.0f} kB")


def test_sample(model: QueryGaussianModel, scene: int) -> Sample:
    """The photos of a test scene of the model's recipe, and its novel views."""
    assert model.recipe is not None
    recipe = resolve(model.recipe)
    return evaluation_samples(recipe.build_data(), recipe.views, recipe.evaluation)[scene]


def draw_worlds() -> None:
    """Write three views of each of the first 15 worlds, those of a scene side by side."""
    scenes = WorldsSource(WorldsConfig(image_size=(96, 96))).scenes("train")
    views = [[rgb_picture(image) for image in scene.images((0, 3, 7))] for scene in scenes[:15]]
    shown = [side_by_side(pictures, gap=1) for pictures in views]
    rows = [side_by_side(shown[start : start + 5], gap=GAP) for start in range(0, len(shown), 5)]
    path = IMAGES / "worlds_scenes.webp"
    write_webp([np.concatenate(rows)], path)
    announce(path)


def draw_rounds(model: QueryGaussianModel, scene: int) -> None:
    """Write what the rounds change: the first novel view without and with them, and its errors."""
    sample, rounds = test_sample(model, scene), model.feedback.rounds
    photo, views = sample.targets.images[0, 0], []
    for count in (0, rounds):
        model.feedback.rounds = count
        prediction = model(sample.inputs)
        views.append(model.render(prediction.gaussians, sample.targets.cameras).rgb[0, 0])
    errors = [color_error(view, photo) for view in views]
    scores = [float(psnr(view, photo)) for view in views]
    pictures = [rgb_picture(image) for image in (photo, *views)]
    pictures += [error_picture(error, 0.3) for error in errors]
    pictures.append(shaded(errors[1] - errors[0], -0.1, 0.1, "RdBu_r"))
    names = [f"rounds: {n}, {score:.2f} dB" for n, score in zip((0, rounds), scores, strict=True)]
    titles = ("novel view", *names, "error, rounds: 0", f"rounds: {rounds}", "change of the error")
    path = IMAGES / "landmark_round.webp"
    write_webp([titled([enlarged(picture, SIDE) for picture in pictures], titles)], path)
    announce(path)


def layers_picture(model: QueryGaussianModel, views: Views) -> Picture:
    """The anchors on the first photo: as learned, and after every layer."""
    prediction = model(views)
    with qgs.trace(model) as trace:
        model(views)
    states = [trace.layers[1].before, *(layer.after for layer in trace.layers.values())]
    chosen = notable_queries(model, prediction.gaussians, views.cameras, OUTLINED)
    colors = {query.index: query.color for query in chosen}
    photo = enlarged(rgb_picture(views.images[0, 0]), SIDE)
    pictures = []
    for state in states:
        assert state is not None
        support = model.queries.support(state)
        assert support is not None
        pictures.append(support_picture(photo, support, views.cameras[:, :1], colors))
    titles = ["as learned", *(f"after layer {number}" for number in trace.layers)]
    return titled(pictures, titles)


if __name__ == "__main__":
    main()
