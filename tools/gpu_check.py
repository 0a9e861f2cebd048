"""Every check that needs a GPU, one after the other, in one report: see gpu_check.sh.

    python tools/gpu_check.py OUT

Each step is a command of its own with a time limit, so that none ends the others. OUT/report.json
has commands, times, exit codes and figures, OUT/report.md the same to read, OUT/logs all output.
"""

import json
import os
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch

ROOT = Path(__file__).parents[1]
TINY = ("tokengs", "locus", "ellipsoid", "c3g", "gslrm", "globalsplat")
PAIR = ("tokengs/dl3dv_4096_4views.yaml", "locus/dl3dv_4096_4views.yaml")
PAPER_RATIO = 1.19
"""Forward latency of LocusGS to TokenGS, as the paper of LocusGS gives it."""


@dataclass(frozen=True)
class Step:
    """One check. limit: seconds. result: a JSON file that the command writes, in the report."""

    name: str
    command: Sequence[str]
    limit: float = 900
    result: str = ""
    environment: Mapping[str, str] = field(default_factory=dict)


@dataclass
class Done:
    """What became of a step. code: its exit code; None where it ran past its limit."""

    name: str
    command: str
    seconds: float
    code: int | None
    tail: str
    found: Any = None

    @property
    def passed(self) -> bool:
        """Whether it ended well in time."""
        return self.code == 0


def steps(out: Path) -> Iterator[Step]:
    """All checks, those on which others rest first."""
    python, tests = (
        sys.executable,
        ("-m", "pytest", "-q", "-p", "no:cacheprovider", "-rs", "-m", ""),
    )
    contract = ("tests/renderers", "tests/engine/test_objective.py", "-k", "gsplat")
    yield Step(
        "gsplat compiles", [python, "-c", "import gsplat.cuda._backend as b; assert b._C"], 1800
    )
    yield Step("renderer contract on gsplat", [python, *tests, *contract], 1800)
    for name in TINY:
        for precision in ("float32", "bf16"):
            run = out / "runs" / f"{name}-{precision}"
            changes = ("--set", "training.steps=200", "--set", f"training.precision={precision}")
            command = ["qgs", "train", f"tiny/{name}.yaml", "--out", str(run), "--device", "cuda"]
            yield Step(f"training of {name}, {precision}", [*command, *changes], 600)
    two = torch.cuda.device_count() > 1
    launch = [python, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    run = ("--out", str(out / "runs/two"), "--set", "training.steps=50")
    device = "cuda" if two else "cpu"  # NCCL refuses two processes on one GPU; gloo is for CPUs
    kind = "two GPUs, NCCL" if two else "one GPU, so on the CPU with gloo"
    program = str(Path(python).with_name("qgs"))
    command = [*launch, program, "train", "tiny/locus.yaml", *run]
    yield Step(f"DDP of two processes ({kind})", [*command, "--device", device], 600)
    memory = ("--memory", "--step", "--rounds", "5", "--device", "cuda", "--json", "memory.json")
    tiny = [f"tiny/{name}.yaml" for name in TINY]
    yield Step("time and peak memory, tiny", ["qgs", "bench", *tiny, *memory], 900, "memory.json")
    yield predicted(tiny, "float32", "tiny")
    for precision in ("float32", "bf16"):
        file = f"latency-{precision}.json"
        options = ("--precision", precision, "--device", "cuda", "--rounds", "30", "--warmup", "5")
        command = ["qgs", "bench", *PAIR, *options, "--memory", "--step", "--json", file]
        yield Step(f"latency at published size, {precision}", command, 900, file)
        yield predicted(PAIR, precision, "published size")
    yield Step("Triton kernels", [python, *tests, "tests/components/test_attention_triton.py"])
    command = [python, str(ROOT / "tools/gpu_attention.py"), "--json", "attention.json"]
    yield Step("attention kernels against float64, timed", command, 900, "attention.json")
    sweep = ("--sweep", "views=2..32", "--sweep", "queries=256..16384", "--json", "sweep.json")
    command = ["qgs", "bench", *PAIR, *sweep, "--device", "cuda", "--rounds", "5"]
    yield Step("growth with views and queries", command, 1800, "sweep.json")


def predicted(recipes: Sequence[str], precision: str, size: str) -> Step:
    """The prediction of what `qgs bench --memory --step` measures of these recipes."""
    file = f"predicted-{size.replace(' ', '-')}-{precision}.json"
    options = ("--batch", "1", "--precision", precision, "--device", "cuda", "--json", file)
    command = ["qgs", "bench", *recipes, "--predict", *options]
    return Step(f"predicted memory, {size}, {precision}", command, 300, file)


def run_step(step: Step, out: Path) -> Done:
    """Run it in OUT's folder of results, which keeps its output."""
    logs, started = out / "logs", time.perf_counter()
    logs.mkdir(parents=True, exist_ok=True)
    log = logs / f"{step.name.replace(' ', '-').replace('/', '-').replace(',', '')}.txt"
    paths = os.pathsep.join([str(ROOT / "tests"), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": paths, **step.environment}
    where = ROOT if "pytest" in step.command else out
    code: int | None = None
    with log.open("w") as file:
        try:
            code = subprocess.run(
                step.command, cwd=where, env=environment, stdout=file, stderr=subprocess.STDOUT,
                timeout=step.limit,
            ).returncode  # fmt: skip
        except subprocess.TimeoutExpired:
            file.write(f"\nran past its limit of {step.limit:g} s\n")
        except OSError as error:
            code = 127
            file.write(f"{error}\n")
    tail = log.read_text(errors="replace")[-4000:]
    done = Done(step.name, shlex.join(step.command), time.perf_counter() - started, code, tail)
    if step.result and (out / step.result).is_file():
        done.found = json.loads((out / step.result).read_text())
    return done


def run_all(found: Sequence[Step], out: Path) -> list[Done]:
    """Run all; the report is written anew after each, so that a machine that goes leaves one."""
    done: list[Done] = []
    for step in found:
        print(f"{step.name} ...", end=" ", flush=True)
        done.append(run_step(step, out))
        print("passed" if done[-1].passed else "FAILED", f"{done[-1].seconds:.0f} s", flush=True)
        write(done, out)
    return done


def write(done: Sequence[Done], out: Path) -> None:
    """OUT/report.json and OUT/report.md."""
    told = machine()
    entries = [{**asdict(one), "passed": one.passed} for one in done]
    text = json.dumps({"report": "gpu_check", "machine": told, "steps": entries}, indent=1)
    (out / "report.json").write_text(text)
    lines = ["# What ran on a GPU", "", *(f"- {name}: {value}" for name, value in told.items()), ""]
    lines += ["| step | | seconds |", "|---|---|--:|"]
    lines += [
        f"| {one.name} | {'passed' if one.passed else 'FAILED'} | {one.seconds:.0f} |"
        for one in done
    ]
    lines += [*latencies(done), *memory(done), *attention(done)]
    for one in done:
        if not one.passed:
            ended = "ran past its limit" if one.code is None else f"ended with {one.code}"
            tail = "\n".join(one.tail.splitlines()[-25:])
            lines += ["", f"## {one.name}", "", f"`{one.command}` {ended}:", "", "```", tail, "```"]
    (out / "report.md").write_text("\n".join(lines) + "\n")


def machine() -> dict[str, Any]:
    """GPUs and versions."""
    count = torch.cuda.device_count()
    return {
        "GPUs": ", ".join(torch.cuda.get_device_name(n) for n in range(count)) or "none",
        "torch": torch.__version__,
        "CUDA": torch.version.cuda,
        "Python": sys.version.split()[0],
    }


def latencies(done: Sequence[Done]) -> Iterator[str]:
    """The paper's table: forward latency of LocusGS to TokenGS."""
    for one in done:
        if one.name.startswith("latency") and one.found:
            yield from ("", f"## {one.name}", "", f"The paper's ratio is {PAPER_RATIO}.", "")
            yield from (
                "| recipe | forward, ms | ratio | step, ms | ratio |",
                "|---|--:|--:|--:|--:|",
            )
            for recipe in one.found["recipes"]:
                cells = [recipe["recipe"]]
                for operation in ("forward", "step"):
                    seconds = recipe["seconds"][operation]
                    ratio = seconds["ratio"]["median"]
                    cells += [f"{1000 * seconds['median']:.2f}", f"{ratio:.3f}"]
                yield f"| {' | '.join(cells)} |"


def memory(done: Sequence[Done]) -> Iterator[str]:
    """What a training step of one scene takes: predicted and measured."""
    found = [
        (recipe["recipe"], recipe["precision"], recipe)
        for one in done
        if one.found and "recipes" in one.found
        for recipe in one.found["recipes"]
    ]
    counted = {(name, precision): r for name, precision, r in found if "tensor_bytes" in r}
    measured = {
        (name, precision): r for name, precision, r in found if "step" in r.get("memory", ())
    }
    if not counted:
        return
    yield from ("", "## Memory of a training step", "")
    yield "Measured is what torch allocated at most; predicted are the tensors of the same step."
    yield from ("", "| recipe | precision | predicted, MiB | measured, MiB | error |")
    yield "|---|---|--:|--:|--:|"
    for name, precision in {**counted, **measured}:
        cells = ["", "", ""]
        if one := counted.get((name, precision)):
            cells[0] = f"{one['tensor_bytes'] / 2**20:,.0f}"
        if two := measured.get((name, precision)):
            cells[1] = f"{two['memory']['step']['peak_bytes'] / 2**20:,.0f}"
        if one and two:
            error = one["tensor_bytes"] / two["memory"]["step"]["peak_bytes"] - 1
            cells[2] = f"{100 * error:+.1f} %"
        yield f"| {name} | {precision} | {' | '.join(cells)} |"


def attention(done: Sequence[Done]) -> Iterator[str]:
    """Errors and times of the kernels of attention."""
    for one in done:
        if one.name.startswith("attention") and one.found:
            yield from ("", f"## {one.name}", "")
            names = [*dict.fromkeys(name for row in one.found["rows"] for name in row)]
            yield f"| {' | '.join(names)} |"
            yield f"|{'---|' * len(names)}"
            for row in one.found["rows"]:
                yield f"| {' | '.join(str(row.get(name, '')) for name in names)} |"


def main() -> int:
    if len(sys.argv) != 2:
        sys.exit("usage: python tools/gpu_check.py OUT")
    if not torch.cuda.is_available():
        print("gpu_check: torch finds no GPU, so there is nothing to check", file=sys.stderr)
        return 2
    out = Path(sys.argv[1]).resolve()
    out.mkdir(parents=True, exist_ok=True)
    done = run_all([*steps(out)], out)
    print(f"written to {out / 'report.md'}")
    return 0 if all(one.passed for one in done) else 1


if __name__ == "__main__":
    raise SystemExit(main())
