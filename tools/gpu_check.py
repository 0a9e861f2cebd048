"""Every check that needs a GPU, in one report: see gpu_check.sh.

    python tools/gpu_check.py OUT [WORD ...]

Each step is a command of its own with a time limit; a step that fails does not stop the others.
Those that measure no time run side by side, the others alone; with WORDs, only steps that have one
of them in their name, after gsplat's build, which others would repeat. OUT/report.md has commands,
results and times, OUT/logs all output.
"""

import json
import math
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from itertools import product
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
import yaml
from qgs_anchors.ellipsoid.fields import anchor_rotation
from qgs_anchors.ellipsoid.ray_bias import EllipsoidBias
from qgs_anchors.ellipsoid.ray_bias import ray_tokens as ellipsoid_tokens
from qgs_locus.kernels.attention_bias import biased_attention
from qgs_locus.ray_bias import RayBias
from qgs_locus.ray_bias import ray_tokens as locus_tokens
from qgs_research.bench.run import in_turn, quartiles
from torch import Tensor

ROOT = Path(__file__).parents[1]
PHASES = yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text("utf-8"))
BUILD = "gsplat compiles"
KERNELS: Any = ("plain", "blocks", "triton")
TOLERANCES = {torch.float32: 1e-5, torch.bfloat16: 4 * 2**-7, torch.float16: 4 * 2**-10}
"""Half precision rounds the output once, and the kernels the weights and their derivative; the
plain path rounds the bias, which is -5 at least here: less than 8 halves of a unit."""

Step = dict[str, Any]
"""name, command, limit: as in gpu_check.yaml, for one combination of its words."""


def steps_of(phase: dict[str, Any], out: Path, words: Sequence[str]) -> Iterator[Step]:
    """Yield the steps of a phase, or those that have one of `words` in their name."""
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
    """Run a step in OUT; return whether it passed, its row of the table, its output's end."""
    log = out / "logs" / f"{step['name'].replace(' ', '-').replace(',', '')}.txt"
    log.parent.mkdir(parents=True, exist_ok=True)
    env = {**os.environ, "PYTHONPATH": str(ROOT / "tests")}
    env["PATH"] = f"{Path(sys.executable).parent}:{env['PATH']}"
    started = time.perf_counter()
    with log.open("w") as file:
        process = subprocess.Popen(
            shlex.split(step["command"]),
            cwd=ROOT if "pytest" in step["command"] else out,
            env=env,
            stdout=file,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        try:
            code = process.wait(step["limit"])
        except subprocess.TimeoutExpired as error:
            # Its own processes too.
            os.killpg(process.pid, signal.SIGKILL)
            code = str(error)
            file.write(f"\n{error}\n")
    verdict = "passed" if code == 0 else "FAILED"
    row = f"| {step['name']} | {verdict} | {time.perf_counter() - started:.0f} |"
    print(row, flush=True)
    end = "\n".join(log.read_text(errors="replace").splitlines()[-40:])
    return code == 0, row, f"## {step['name']}\n\n`{step['command']}`\n\n```\n{end}\n```"


def report(out: Path, words: Sequence[str]) -> bool:
    """Run the steps, and write OUT/report.md anew after each; return whether all passed."""
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


def drawn(kind: str, queries: int, tokens: int, heads: int, lowest: float = -5.0) -> Any:
    """q, k, v, the output's gradient, and a bias of random anchors and rays, on the GPU."""
    draw = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(1, *shape, generator=draw).cuda()

    q, k, v, out = (normal(heads, n, 64) for n in (queries, tokens, tokens, queries))
    directions = F.normalize(normal(tokens, 3), dim=-1)
    rays = torch.cat([torch.linalg.cross(normal(tokens, 3), directions), directions], -1)
    center = normal(queries, 3)
    variance = (0.3 + normal(queries, 3).abs()).square()
    last = lowest, torch.tensor(0.9, device="cuda")
    if kind == "locus":
        return q, k, v, out, RayBias.of(center, variance[..., :1], locus_tokens(rays), *last)
    rotation = anchor_rotation(normal(queries, 4))
    bias = EllipsoidBias.of(center, rotation, variance, ellipsoid_tokens(rays), *last)
    return q, k, v, out, bias


def worst_error(kernel: Any, dtype: torch.dtype) -> float:
    """Largest error of the output and of q's, k's and v's gradients, relative to the largest value.

    The truth is float64 autograd of the formula, from the same rounded inputs.
    """
    errors = []
    for kind in ("locus", "ellipsoid"):
        for lowest, queries in ((-5.0, 257), (-1e9, 257), (-1e-9, 257), (-5.0, 1)):
            *given, bias = drawn(kind, queries, 1031, 2, lowest)
            *leaves, out = (x.to(dtype) for x in given)
            ours = [x.clone().requires_grad_() for x in leaves]
            found = biased_attention(ours[0], ours[1], ours[2], bias, kernel)
            found.backward(out)
            truth = [x.double().requires_grad_() for x in leaves]
            scores = truth[0] @ truth[1].mT / 8 + bias.dense().double()[:, None]
            true = scores.softmax(-1) @ truth[2]
            true.backward(out.double())
            pairs = [(found, true), *((a.grad, b.grad) for a, b in zip(ours, truth, strict=True))]
            errors += [((a.double() - b).abs().max() / b.abs().max()).item() for a, b in pairs]
    return math.inf if any(map(math.isnan, errors)) else max(errors)


def attention() -> bool:
    """Print errors of each kernel of attention, and its time and memory at published size."""
    good = True
    for kernel in KERNELS:
        for dtype, tolerance in TOLERANCES.items():
            error = worst_error(kernel, dtype)
            good &= error <= tolerance
            print(json.dumps({"kernel": kernel, "dtype": str(dtype), "error": error}), flush=True)
    q, k, v, _, bias = drawn("locus", 4096, 7168, 16)
    for x in (q, k, v):
        x.requires_grad_()

    def step(kernel: Any) -> None:
        plain = F.scaled_dot_product_attention
        out = biased_attention(q, k, v, bias, kernel) if kernel else plain(q, k, v)
        out.sum().backward()

    for kernel in (None, *KERNELS):
        step(kernel)
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        (samples,) = in_turn([lambda kernel=kernel: step(kernel)], 10, 1)
        memory = (torch.cuda.max_memory_allocated() - before) / 2**20
        row = {"kernel": kernel or "no bias", "ms": 1000 * quartiles(samples)["median"]}
        print(json.dumps(row | {"MiB": memory}), flush=True)
    return good


def main() -> int:
    if len(sys.argv) < 2:
        sys.exit("usage: python tools/gpu_check.py OUT [WORD ...]")
    if not torch.cuda.is_available():
        print("gpu_check: torch finds no GPU, so there is nothing to check", file=sys.stderr)
        return 2
    if sys.argv[1] == "--attention":
        return int(not attention())
    out = Path(sys.argv[1]).resolve()
    out.mkdir(parents=True, exist_ok=True)
    return int(not report(out, sys.argv[2:]))


if __name__ == "__main__":
    raise SystemExit(main())
