"""How much `qgs.refine` gains: held-out PSNR against seconds, on scenes and by number of photos.

    python tools/measure_refinement.py CHECKPOINT SCENE... --out curves.json [--photos 0 2 4]

SCENE is a folder of photos, or "room" for a room of the checkpoint's test split. --photos: how many
are optimised on; 0 stands for all that are not compared with. Each is refined from the prediction
and from random points about the look-at point; frames and scale are those of `qgs reconstruct`
with views.scale=auto (a room keeps the recipe's). Prints a line a run and writes the curves; --plot
draws those of a file. Seconds are CPU seconds of one thread, so that other work on the machine
does not count.
"""

import argparse
import json
import time
from pathlib import Path
from unittest.mock import patch

import torch

import qgs
from qgs.analysis.reconstruction import choose_sample
from qgs.analysis.scenes import chosen_scene
from qgs.contracts import Scene
from qgs.data.sampling import Sample, training_frames, views_in
from qgs.engine.folder import checkpoint_of
from qgs.engine.refining import mean_psnr
from qgs.io.checkpoint import load_recipe
from qgs.io.files import write_text
from qgs.types import Gaussians, Views

ROOM_VIEWS = 29
"""On the path of a room, 4 for each of the 8 between which the inputs of the recipe are chosen."""


def random_points(count: int, seed: int = 0) -> Gaussians:
    """Gaussians (1, count) about the point at depth 1 of the first camera."""
    generator = torch.Generator().manual_seed(seed)
    means = 0.15 * torch.randn(1, count, 3, generator=generator) + torch.tensor([0.0, 0, 1])
    scales = torch.full((1, count, 3), 0.15 / count ** (1 / 3))
    quats = torch.tensor([1.0, 0, 0, 0]).repeat(1, count, 1)
    colors = torch.rand(1, count, 3, generator=generator)
    return Gaussians(means, scales, quats, torch.full((1, count), 0.1), colors)


def opened(recipe, name: str, split: str, size: tuple[int, int] | None) -> tuple[Scene, str]:
    """The scene `name`, and how its world is scaled."""
    if name == "room":
        data = recipe.build_data()
        views = {"views_per_scene": ROOM_VIEWS}
        finer = type(data)(data.config.model_copy(update=views))
        return finer.scenes(split)[0], recipe.views.scale
    return chosen_scene(recipe, name, size, None)[0], "auto"


def room_frames(inputs: int) -> tuple[list[int], list[int]]:
    """Inputs, ends included, over five of the seven parts of the path, and four between them."""
    return [4 + round(20 * k / (inputs - 1)) for k in range(inputs)], [8, 12, 15, 20]


def photos_of(scene: Scene, sample: Sample, world, photos: int) -> Views:
    """What is optimised on: the inputs where `photos` says how many, else all but the compared."""
    if photos:
        return sample.inputs
    rest = tuple(frame for frame in training_frames(scene) if frame not in sample.target_frames)
    return views_in(world, scene, rest)


def measure(model, recipe, name: str, photos: int, arguments) -> list[dict]:
    """Runs on one scene from both starts, with their curves."""
    scene, scale = opened(recipe, name, arguments.split, arguments.size)
    views = recipe.views.model_copy(update={"scale": scale})
    frames = room_frames(photos or views.inputs) if name == "room" else (None, None)
    sample, world = choose_sample(scene, views, photos or None, *frames)
    optimised = photos_of(scene, sample, world, photos)
    with torch.no_grad():
        predicted = model(sample.inputs).gaussians
    starts = {"prediction": predicted, "random": random_points(predicted.count)}
    records = []
    for start, gaussians in starts.items():
        with patch("qgs.engine.refining.perf_counter", time.process_time):
            result = qgs.refine(
                gaussians, optimised, arguments.seconds, count=arguments.gaussians,
                compared=sample.targets, renderer=model.renderer,
            )  # fmt: skip
        curve = [(point.seconds, point.psnr) for point in result.curve]
        record = {"scene": Path(name).name, "photos": optimised.images.shape[1], "start": start}
        record |= {"compared": len(sample.target_frames), "steps": result.steps, "curve": curve}
        record["fitted"] = mean_psnr(result.gaussians, optimised, model.renderer)
        shown = "  ".join(f"{seconds:.0f} s {value:.2f}" for seconds, value in curve)
        print(
            f"{record['scene']}, {record['photos']} photos, from {start}, {result.steps} steps, "
            f"fitted {record['fitted']:.2f}: {shown}", flush=True
        )  # fmt: skip
        records.append(record)
    return records


def draw(file: Path, picture: Path) -> None:
    """The curves of `file`, a panel a scene."""
    from matplotlib.figure import Figure

    runs = json.loads(file.read_text())
    scenes = list(dict.fromkeys(run["scene"] for run in runs))
    figure = Figure(figsize=(3 * len(scenes), 3), layout="constrained")
    panels = figure.subplots(1, len(scenes), squeeze=False)[0]
    for panel, scene in zip(panels, scenes, strict=True):
        for run in (run for run in runs if run["scene"] == scene):
            style = "-" if run["start"] == "prediction" else "--"
            color = {2: "C0", 4: "C1"}.get(run["photos"], "C2")
            label = f"{run['photos']} photos, {run['start']}"
            panel.plot(*zip(*run["curve"], strict=True), style, color=color, label=label)
        panel.set(title=scene, xlabel="seconds", ylabel="PSNR, dB")
        panel.legend(fontsize=6)
    figure.savefig(picture, dpi=90)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--photos", type=int, nargs="+", default=[0])
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--gaussians", type=int)
    parser.add_argument("--size", type=int, nargs=2, help="height and width of a folder's photos")
    parser.add_argument("--split", default="test", choices=["train", "test"])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--plot", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    file = checkpoint_of(arguments.checkpoint)
    model, recipe = qgs.load(file), load_recipe(file)
    runs = []
    for name in arguments.scenes:
        for photos in arguments.photos:
            runs += measure(model, recipe, name, photos, arguments)
            write_text(arguments.out, json.dumps(runs))
    if arguments.plot:
        draw(arguments.out, arguments.plot)


if __name__ == "__main__":
    main()
