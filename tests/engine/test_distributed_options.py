"""Two processes train with parts, averages, evaluations, and a NaN that only one sees."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import yaml
from safetensors.torch import load_file
from training_runs import Tiny

from qgs.composer import Recipe

WORKER = Path(__file__).with_name("distributed_incident.py")


def trained_by_two(recipe: Recipe, folder: Path) -> list[str]:
    """What the two processes print of a training into `folder`/run."""
    (folder / "recipe.yaml").write_text(yaml.safe_dump(dict(recipe.tree)))
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        port = listener.getsockname()[1]
    common = {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    command = [sys.executable, str(WORKER), str(folder / "recipe.yaml"), str(folder / "run")]
    processes = [
        subprocess.Popen(
            command,
            env={**os.environ, **common, "RANK": rank, "LOCAL_RANK": rank, "OMP_NUM_THREADS": "1"},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for rank in ("0", "1")
    ]
    try:
        outputs = [process.communicate(timeout=180) for process in processes]
    finally:
        for process in processes:
            process.kill()
    assert [process.returncode for process in processes] == [0, 0], outputs
    return [out for out, _ in outputs]


def test_all_processes_leave_out_a_step_that_one_found_bad(tiny: Tiny, tmp_path: Path) -> None:
    recipe = tiny(
        "locus",
        "training.steps=4",
        "training.batch_size=1",
        "training.render_views=1",
        "training.on_nonfinite=skip",
        "training.ema=0.9",
        "training.evaluate_every=2",
        "evaluation.scenes=1",
    )
    said = [out.split()[-3:] for out in trained_by_two(recipe, tmp_path)]
    assert [main for main, *_ in said] == ["True", "False"]
    assert said[0][1:] == said[1][1:] == ["4", said[0][2]], "the same weights everywhere"
    run = tmp_path / "run"
    records = [json.loads(line) for line in (run / "history.jsonl").read_text().splitlines()]
    assert ["loss" in record for record in records] == [True, False, True, True]
    incident = run / "incidents" / "step-2"
    report = json.loads((incident / "report.json").read_text())
    first = {found["process"]: found["first"] for found in report["found"]}
    assert first[0] is None
    assert first[1]["tensor"] == "targets.images"
    seen = [load_file(incident / f"batch{n}.safetensors")["targets.images"] for n in ("", "-1")]
    assert [int(images.isnan().sum()) for images in seen] == [0, 1]
    judged = [json.loads(line) for line in (run / "evaluations.jsonl").read_text().splitlines()]
    assert [(record["step"], record["weights"]) for record in judged] == [
        (step, weights) for step in (2, 4) for weights in ("raw", "ema")
    ]
