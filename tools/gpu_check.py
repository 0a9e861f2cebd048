"""All checks that need a GPU, in one report; see gpu_check.sh.

    python tools/gpu_check.py OUT [WORD ...]

Each step is a command with a time limit. A failed step does not stop the other steps. Steps that
measure time run alone; all other steps run in parallel. With WORDs, only steps with one of the
words in their name run, beside the build of gsplat, which many need. OUT/report.md lists commands,
results and times; OUT/logs has the output of all steps.
"""

import os
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import partial
from importlib import import_module
from itertools import product
from pathlib import Path
from typing import Any

import torch
import yaml
from qgs_research.bench.run import in_turn, make_task, quartiles, workload_of
from size import ROOT

from qgs.recipe import resolve

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


SIZES = ((1, 16, 4096, 7168, 64), (1, 6, 1024, 4096, 64))


def median(task: Callable[[], object]) -> float:
    """Return the median of the milliseconds of ten calls."""
    (samples,) = in_turn([task], 10, 3)
    return 1000 * quartiles(samples)["median"]


def time_attention() -> None:
    """Print time and memory of each way of attention, in inference and in training."""
    # Of the tests, which are on the path of a step.
    attending: Any = import_module("attending")
    # The last may fail.
    for name, sizes, learns in product(attending.WAYS, SIZES, (False, True)):
        step = attending.step_of(name, sizes)
        torch.cuda.reset_peak_memory_stats()
        with torch.set_grad_enabled(learns):
            taken = median(step)
        memory = torch.cuda.max_memory_allocated() / 2**20
        print(f"{name}, {sizes}, {learns=}: {taken:.3f} ms, {memory:.0f} MiB")


def time_models(captured: bool) -> None:
    """Print operators and time by part, or time as a captured graph with its largest difference."""
    parts: Any = import_module("model_parts")
    for name in ("tokengs/dl3dv_4096_4views.yaml", "locus/dl3dv_4096_4views.yaml"):
        recipe = resolve(name)
        model = recipe.build_model("cuda").eval()
        work = workload_of(recipe, device="cuda", precision="bf16")
        task: Any = make_task("forward", recipe, model, work)
        expected = task().means
        if captured:
            model.compile()
            # The third call replays a graph.
            for _ in range(3):
                first = task().means.clone()
            torch.testing.assert_close(task().means, first, rtol=0, atol=0)
            print(f"{(first - expected).abs().max():.2e} apart")
        print(f"{name}: {median(task):.2f} ms")
        if not captured:
            print(parts.parts_of(model, task))


MEASUREMENTS = {
    "--attention": time_attention,
    "--models": partial(time_models, False),
    "--captured": partial(time_models, True),
}


def main() -> int:
    if len(sys.argv) < 2:
        sys.exit("usage: python tools/gpu_check.py OUT [WORD ...]")
    if not torch.cuda.is_available():
        print("gpu_check: torch finds no GPU, so there is nothing to check", file=sys.stderr)
        return 2
    if sys.argv[1] in MEASUREMENTS:
        MEASUREMENTS[sys.argv[1]]()
        return 0
    out = Path(sys.argv[1]).resolve()
    out.mkdir(parents=True, exist_ok=True)
    return int(not report(out, sys.argv[2:]))


if __name__ == "__main__":
    raise SystemExit(main())
