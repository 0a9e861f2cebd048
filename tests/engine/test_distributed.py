"""Two processes on one machine train one model."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import yaml

from qgs.composer import Recipe

WORKER = Path(__file__).with_name("distributed.py")


def free_port() -> int:
    """A TCP port that is free now."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


def test_two_processes_train_alike_and_one_writes(
    tiny: Callable[..., Recipe], tmp_path: Path
) -> None:
    recipe = tiny("locus", "training.steps=3", "training.save_every=1", "training.batch_size=1")
    (tmp_path / "recipe.yaml").write_text(yaml.safe_dump(dict(recipe.tree)))
    port = free_port()
    processes = []
    for rank in range(2):
        environment = {
            **os.environ,
            "WORLD_SIZE": "2",
            "RANK": str(rank),
            "LOCAL_RANK": str(rank),
            "MASTER_ADDR": "127.0.0.1",
            "MASTER_PORT": str(port),
            "OMP_NUM_THREADS": "1",
        }
        command = [sys.executable, str(WORKER), str(tmp_path / "recipe.yaml"), str(tmp_path / "r")]
        processes.append(
            subprocess.Popen(
                command,
                env=environment,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
            )
        )
    try:
        outputs = [process.communicate(timeout=120) for process in processes]
    finally:
        for process in processes:
            process.kill()
    assert [process.returncode for process in processes] == [0, 0], outputs
    said = [out.split()[-3:] for out, _ in outputs]
    assert [main for main, *_ in said] == ["True", "False"]
    assert said[0][1:] == said[1][1:] == ["3", said[0][2]], "the same weights everywhere"
    names = {path.name for path in (tmp_path / "r").iterdir()}
    files = ("recipe.yaml", "history.jsonl", "checkpoint.safetensors", "state.safetensors")
    assert names == set(files)
    lines = (tmp_path / "r" / "history.jsonl").read_text().splitlines()
    assert [json.loads(line)["step"] for line in lines] == [1, 2, 3]
