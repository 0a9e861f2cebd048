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
from qgs_photos.datasets.chunk_files import list_scenes, load_chunk
from upath import UPath

from qgs.evaluate.results import markdown_table
from qgs.files import write_text

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


def read_scores(results: Path) -> dict[str, float]:
    """Mean PSNR over windows of the model and of the baselines.

    Raises ValueError for a window without a score.
    """
    with (results / "scenes.csv").open(encoding="utf-8") as lines:
        windows = [*csv.DictReader(lines)]
    scores: dict[str, float] = {}
    for name in ("model", "nearest_input", "mean_colour"):
        values = [window[f"{name}_psnr"] for window in windows]
        if "" in values:
            raise ValueError(f"{results / 'scenes.csv'} has no {name}_psnr of some windows")
        scores[name] = mean(map(float, values))
    return scores


def table_rows(out: Path) -> list[list[str]]:
    """Headers; a row a scene: mean PSNR over windows and seeds of every variant, baselines.

    Over the seeds that all variants of the scene have finished; one that has finished none has no
    value, and is held against none.
    """
    found: dict[str, dict[str, dict[str, dict[str, float]]]] = {}
    for file in sorted(out.glob("*/study/runs/*/*/evaluation/protocol.json")):
        scene, variant, seed = file.parts[-7], file.parts[-4], file.parts[-3]
        by_seed = found.setdefault(scene, {}).setdefault(variant, {})
        by_seed[seed] = read_scores(file.parent)
    if not found:
        raise ValueError(f"{out} has no finished study; run them first, see --help")
    variants = sorted({variant for of_scene in found.values() for variant in of_scene})
    names = [*variants, "nearest input", "mean colour"]
    rows, whole = [], []
    for scene, of_scene in found.items():
        seeds = sorted(set.intersection(*(set(by_seed) for by_seed in of_scene.values())))
        first = next(iter(of_scene.values()))
        values = {v: [by_seed[s]["model"] for s in seeds] for v, by_seed in of_scene.items()}
        values |= {n: [first[s][n.replace(" ", "_")] for s in seeds] for n in names[-2:]}
        means = {name: mean(of_seeds) for name, of_seeds in values.items() if of_seeds}
        rows.append([scene, *(f"{means[n]:.2f}" if n in means else "" for n in names)])
        rows[-1].append(", ".join(seed.removeprefix("seed-") for seed in seeds))
        whole += [means] * (means.keys() == {*names})
    cells = [f"{mean(means[n] for means in whole):.2f}" if whole else "" for n in names]
    return [["scene left out", *names, "seeds"], *rows, ["mean of full rows", *cells, ""]]


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("chunks", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--table", action="store_true", help="of the studies that are finished")
    options = parser.parse_args()
    if options.table:
        print(markdown_table(table_rows(options.out)))
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
