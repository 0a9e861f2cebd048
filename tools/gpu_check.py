"""All checks that need a GPU, in one report; see gpu_check.sh.

    python tools/gpu_check.py OUT [WORD ...]

Each step is a command with a time limit. A failed step does not stop the other steps. Steps that
measure time run alone; all other steps run in parallel. With WORDs, only steps with one of the
words in their name run, after the build of gsplat, which all need. OUT/report.md lists commands,
results and times; OUT/logs has the output of all steps.
"""

import json
import os
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from importlib import import_module
from itertools import product
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
import yaml
from qgs_locus.kernels.attention_bias import biased_attention
from qgs_locus.ray_bias import RayBias
from qgs_research.bench.run import in_turn, quartiles
from size import ROOT

PHASES = yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text("utf-8"))
BUILD = "gsplat compiles"

Step = dict[str, Any]
"""Step of the report: name, command and time limit, as in gpu_check.yaml."""


def steps_of(phase: dict[str, Any], out: Path, words: Sequence[str]) -> Iterator[Step]:
    """Yield the steps of a phase; if `words` are given, steps with one of them in their name."""
    places = {
        "out": shlex.quote(str(out)),
        "root": ROOT,
        "qgs": Path(sys.executable).with_name("qgs"),
        "device": "cuda" if torch.cuda.device_count() > 1 else "cpu",
    }
    for step in phase["steps"]:
        each = step.get("each", {})
        for chosen in product(*each.values()):
            values = places | dict(zip(each, chosen, strict=True))
            name = step["name"].format(**values)
            if not words or any(word in name for word in (BUILD, *words)):
                yield {**step, "name": name, "command": step["command"].format(**values)}


def run_step(step: Step, out: Path) -> tuple[bool, str, str]:
    """Run a step; return whether it passed, its row in the report, and the end of its output.

    out: folder OUT.
    """
    log = out / "logs" / f"{step['name'].replace(' ', '-').replace(',', '')}.txt"
    log.parent.mkdir(parents=True, exist_ok=True)
    env = {**os.environ, "PYTHONPATH": str(ROOT / "tests")}
    env["PATH"] = f"{Path(sys.executable).parent}:{env['PATH']}"
    started = time.perf_counter()
    # Its own processes end with it.
    command = ["timeout", "--signal=KILL", str(step["limit"]), *shlex.split(step["command"])]
    folder = ROOT if "pytest" in step["command"] else out
    with log.open("w") as file:
        code = subprocess.run(command, cwd=folder, env=env, stdout=file, stderr=file).returncode
    verdict = "passed" if code == 0 else "FAILED"
    row = f"| {step['name']} | {verdict}, {code} | {time.perf_counter() - started:.0f} |"
    print(row, flush=True)
    end = "\n".join(log.read_text(errors="replace").splitlines()[-40:])
    return code == 0, row, f"## {step['name']}\n\n`{step['command']}`\n\n```\n{end}\n```"


def report(out: Path, words: Sequence[str]) -> bool:
    """Run all steps and rewrite OUT/report.md after each; return True if all passed."""
    names = [torch.cuda.get_device_name(n) for n in range(torch.cuda.device_count())]
    head = f"# Checks on {', '.join(names)}, torch {torch.__version__}, CUDA {torch.version.cuda}"
    results: list[tuple[bool, str, str]] = []
    for phase in PHASES:
        with ThreadPoolExecutor(os.cpu_count() if phase["together"] else 1) as pool:
            runs = [pool.submit(run_step, step, out) for step in steps_of(phase, out, words)]
            for run in as_completed(runs):
                results.append(run.result())
                rows = "\n".join(row for _, row, _ in results)
                ends = "\n\n".join(end for _, _, end in results)
                text = f"{head}\n\n| step | | seconds |\n|---|---|--:|\n{rows}\n\n{ends}\n"
                (out / "report.md").write_text(text)
    return all(passed for passed, _, _ in results)


def time_attention() -> None:
    """Print time and memory of each attention kernel, at the size of the published models."""
    # Of the tests, which are on the path of a step.
    case: Any = import_module("attending").case
    given = {name: x.cuda() for name, x in case((1, 16, 4096, 7168, 64)).items()}
    q, k, v = (given[name].requires_grad_() for name in "qkv")
    bias = RayBias(given["queries"], given["tokens"])

    def step(kernel: Any) -> None:
        plain = F.scaled_dot_product_attention
        out = biased_attention(q, k, v, bias, kernel) if kernel else plain(q, k, v)
        out.sum().backward()

    for kernel in (None, "plain", "blocks", "triton"):
        step(kernel)
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        (samples,) = in_turn([lambda kernel=kernel: step(kernel)], 10, 1)
        memory = (torch.cuda.max_memory_allocated() - before) / 2**20
        row = {"kernel": kernel or "no bias", "ms": 1000 * quartiles(samples)["median"]}
        print(json.dumps(row | {"MiB": memory}), flush=True)


def main() -> int:
    if len(sys.argv) < 2:
        sys.exit("usage: python tools/gpu_check.py OUT [WORD ...]")
    if not torch.cuda.is_available():
        print("gpu_check: torch finds no GPU, so there is nothing to check", file=sys.stderr)
        return 2
    if sys.argv[1] == "--attention":
        time_attention()
        return 0
    out = Path(sys.argv[1]).resolve()
    out.mkdir(parents=True, exist_ok=True)
    return int(not report(out, sys.argv[2:]))


if __name__ == "__main__":
    raise SystemExit(main())
