"""Compare programs that make Gaussians of photos, with equal photos, poses, points and wall time.

    qgs poses PHOTOS --out POSED
    python -c "import pycolmap; pycolmap.undistort_images('SCENE', 'POSED/sparse/0',
        'POSED/images', undistort_options={'max_image_size': 256})"
    python tools/peers.py tools/peers.yaml SECONDS SCENE ...

The YAML file has the programs' commands. Programs get neither the poses of held-out photos (every
eighth) nor points that only these show. A program that counts steps starts with 200 of them, and
runs again at the pace of the run before until it takes SECONDS, 5 % more or less, nine times at
most. `qgs` renders the PLY file that it wrote, over black, and scores it on the held-out photos.
Rows are printed as Markdown, and appended to peers.jsonl. `taskset` before the command limits all
programs to the same cores. Run it once before: `qgs` compiles in its first run.
"""

import json
import subprocess
from pathlib import Path

import typer
import yaml
from qgs_photos.viewing import VIEWER

from qgs.data.view_samplers import held_out_frames
from qgs.metrics.images import psnr, ssim
from qgs.reconstruction.scene_formats import load_ply
from qgs.reconstruction.scenes import HOLDOUT, read_photos
from qgs.types import Views


def main(programs: Path, seconds: float, scenes: list[Path]) -> None:
    print(
        "| scene | program | seconds | KiB | steps | Gaussians | PSNR, dB | SSIM |\n"
        "|---|---|--:|--:|--:|--:|--:|--:|"
    )
    commands = yaml.safe_load(programs.read_text())
    for scene in scenes:
        views = split(scene)
        height, width = views.cameras.size
        for name, command in commands.items():
            out = scene / "peers" / name
            given = (
                f"photos={scene}/peers out={out} size={height}x{width} minutes={seconds / 60}\n"
                "ln -sfn ../images $photos/images; rm -rf $out; mkdir $out\n"
            )
            taken = run(given + command, seconds)
            steps = (out / "steps").read_text().strip()
            gaussians = load_ply(out / "scene.ply")
            images = VIEWER(gaussians, views.cameras).rgb
            decibels = f"{psnr(images, views.images).mean():.2f}"
            similarity = f"{ssim(images, views.images).mean():.3f}"
            row = [scene.name, name, *taken, steps, f"{gaussians.count}", decibels, similarity]
            print(f"| {' | '.join(row)} |")
            with Path("peers.jsonl").open("a") as rows:
                print(json.dumps(row), file=rows)


def split(scene: Path) -> Views:
    """Write a COLMAP model without held-out photos into peers/; return these photos, (1, H)."""
    # Only after torch: with pycolmap 4.2 first, zlib breaks the memory.
    import pycolmap

    model = pycolmap.Reconstruction(scene / "sparse")
    images = sorted(model.images.values(), key=lambda image: image.name)
    held_out = held_out_frames(len(images), HOLDOUT)
    for frame in held_out:
        model.deregister_frame(images[frame].frame_id)
    (scene / "peers").mkdir(exist_ok=True)
    model.write(scene / "peers")
    return read_photos(scene, frames=held_out)


def run(command: str, seconds: float) -> list[str]:
    """Run a program, with other `$steps` until it takes `seconds`: wall time, and memory in KiB."""
    log = Path("peers.time")
    steps = 200
    for _ in range(9):
        shell = f"steps={steps}; {command}"
        subprocess.run(["time", "-o", log, "-f", "%e %M", "sh", "-ec", shell], check=True)
        taken = log.read_text().split()
        pace = seconds / float(taken[0])
        steps = round(steps * pace)
        if 0.95 < pace < 1.05 or "$steps" not in command:
            break
    return taken


if __name__ == "__main__":
    typer.run(main)
