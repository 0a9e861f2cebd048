"""One other Python process, which imports, builds, loads and runs components afresh."""

from __future__ import annotations

import atexit
import inspect
import json
import os
import subprocess
import sys
from functools import cache
from typing import Any

import torch

from qgs.contracts.component import MissingExtraError
from qgs.testing.case import Case
from qgs.testing.faults import CannotCheck, ElsewhereError


def ask(task: str, case: Case, **details: Any) -> dict[str, Any]:
    """The answer of the other process; raises ElsewhereError for one that it could not give.

    Raises CannotCheck for a component that no other process can import.
    """
    component = case.component
    if "<locals>" in component.__qualname__ or component.__module__ == "__main__":
        raise CannotCheck("no other process can import a class that is defined in a function")
    request = {
        "task": task,
        "module": component.__module__,
        "file": inspect.getfile(component),
        "class": component.__qualname__,
        "config": case.config.model_dump_json(),
        "dims": [case.dims.width, case.dims.heads, case.dims.depth],
        "image_size": case.image_size,
        **details,
    }
    process = _process()
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write(json.dumps(request) + "\n")
    process.stdin.flush()
    line = process.stdout.readline()
    if not line:
        _process.cache_clear()
        raise ElsewhereError("the other process died")
    answer = json.loads(line)
    if "missing" in answer:
        raise MissingExtraError(answer["missing"])
    if "error" in answer:
        raise ElsewhereError(f"in another process: {answer['error']}")
    return answer


@cache
def _process() -> subprocess.Popen[str]:
    settings = json.dumps({"path": sys.path, "threads": torch.get_num_threads()})
    process = subprocess.Popen(
        [sys.executable, "-c", _START, settings],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONHASHSEED": "random"},
    )
    atexit.register(_stop, process)
    return process


_START = """
import json, sys
sys.path[:] = json.loads(sys.argv[1])["path"]
from qgs.testing.serve import serve
serve(json.loads(sys.argv[1])["threads"])
"""


def _stop(process: subprocess.Popen[str]) -> None:
    assert process.stdin is not None
    process.stdin.close()
    process.wait(timeout=30)
