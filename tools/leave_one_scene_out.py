"""Real photos, leave one scene out: a data set and a study for each scene; then their table.

    python tools/leave_one_scene_out.py CHUNKS OUT
    for scene in OUT/*/; do qgs study $scene/study.yaml --out $scene/study; done
    python tools/leave_one_scene_out.py CHUNKS OUT --table

CHUNKS holds RealEstate10K-style chunks in train/ and test/. OUT/SCENE/train gets all but one scene.
OUT/SCENE/test gets that one, once for each window of 13 frames: every fourth is an input, the ones
half way between are targets (a shorter scene has one window, of every other frame). A study is
recipes/studies/photos/scene_left_out.yaml with these paths.
"""

import argparse
import csv
import json
from pathlib import Path
from statistics import mean
from typing import Any

import torch
import yaml
from upath import UPath

from qgs.data.chunk_files import list_scenes, load_chunk
from qgs.io.files import write_text

STUDY = Path(__file__).parents[1] / "recipes" / "studies" / "photos" / "scene_left_out.yaml"
INPUTS = 4


def windows(frames: int) -> list[dict[str, list[int]]]:
    """Input and target frames of the windows of a scene, as an evaluation index has them."""
    step = 4 if frames > 4 * (INPUTS - 1) else 2
    span = step * (INPUTS - 1)
    found = []
    for first in range(0, frames - span, span):
        context = list(range(first, first + span + 1, step))
        found.append({"context": context, "target": [frame + step // 2 for frame in context[:-1]]})
    return found


def write_fold(folder: Path, left_out: dict[str, Any], others: list[dict[str, Any]]) -> None:
    """The data set and the study of one scene."""
    name = left_out["key"]
    index = {f"{name}_{i}": w for i, w in enumerate(windows(len(left_out["images"])))}
    parts = {"train": others, "test": [{**left_out, "key": key} for key in index]}
    for part, entries in parts.items():
        (folder / part).mkdir(parents=True, exist_ok=True)
        torch.save(entries, folder / part / "000000.torch")
        keys = {entry["key"]: "000000.torch" for entry in entries}
        write_text(folder / part / "index.json", json.dumps(keys))
    write_text(folder / "test.json", json.dumps(index, indent=1))
    overlay = {
        "data": {"path": str(folder.resolve())},
        "evaluation": {"index": str((folder / "test.json").resolve())},
    }
    study = {"study": 1, "extends": str(STUDY), "overlay": overlay}
    write_text(folder / "study.yaml", yaml.safe_dump(study))


def print_table(out: Path) -> None:
    """A row a scene: mean PSNR, over seeds and windows, of every variant and of the baselines."""
    rows: dict[str, dict[str, list[float]]] = {}
    for file in sorted(out.glob("*/study/runs/*/*/evaluation/scenes.csv")):
        scene, variant = file.parts[-7], file.parts[-4]
        row = rows.setdefault(scene, {})
        with file.open(encoding="utf-8") as lines:
            for window in csv.DictReader(lines):
                row.setdefault(variant, []).append(float(window["model_psnr"]))
                for baseline in ("nearest_input", "mean_colour"):
                    row.setdefault(baseline, []).append(float(window[f"{baseline}_psnr"]))
    names = sorted({name for row in rows.values() for name in row})
    print("| scene left out |", " | ".join(names), "|\n|---|" + "--:|" * len(names))
    whole = [row for row in rows.values() if row.keys() == {*names}]
    rows["mean of rows without a gap"] = {n: [mean(row[n]) for row in whole] for n in names}
    for scene, row in rows.items():
        print(
            f"| {scene} |",
            " | ".join(f"{mean(row[n]):.2f}" if n in row else "" for n in names),
            "|",
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("chunks", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--table", action="store_true", help="of the studies that are finished")
    options = parser.parse_args()
    if options.table:
        print_table(options.out)
        return
    entries = {}
    for part in ("train", "test"):
        for chunk in set(list_scenes(UPath(options.chunks / part)).values()):
            entries |= {entry["key"]: entry for entry in load_chunk(chunk)}
    for name, entry in sorted(entries.items()):
        others = [other for key, other in sorted(entries.items()) if key != name]
        write_fold(options.out / name, entry, others)
        print(f"{options.out / name}: {len(windows(len(entry['images'])))} windows")


if __name__ == "__main__":
    main()
