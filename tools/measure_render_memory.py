"""Peak memory of a training step against the number of target views, with and without chunks.

    python tools/measure_render_memory.py [--render-views 2] [--views 2 16] [--device cpu]

Each measurement runs in a process of its own, on procedural rooms. On the CPU it is the resident
set's high-water mark (Linux), with glibc told to give freed memory back; on CUDA it is what torch
has allocated. "step" leaves out what the process holds before the step: libraries, kernels, weights
and the batch.
"""

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

import torch
from process_memory import megabytes

from qgs.composer import resolve
from qgs.data.stream import training_batches
from qgs.engine.objective import TrainingPass

RECIPE = Path(__file__).parents[1] / "recipes" / "tiny" / "tokengs.yaml"
SIDE = 256
QUERIES, GAUSSIANS_PER_QUERY = 512, 64


def step_memory(views: int, render_views: int, device: str) -> dict[str, float]:
    """MB before and at the peak of one forward and backward pass in this process."""
    recipe = resolve(
        RECIPE,
        [
            f"data.image_size=[{SIDE}, {SIDE}]",
            "model.encoder.patch_size=16",
            f"model.queries.count={QUERIES}",
            f"model.head.gaussians_per_query={GAUSSIANS_PER_QUERY}",
            f"views.targets={views}",
            "views.gap=[4, 8]",
        ],
    )
    torch.manual_seed(0)
    model = recipe.build_model(device).train()
    objective = TrainingPass(model, recipe.build_losses(), render_views).to(device)
    stream = training_batches(recipe.build_data(), recipe.views, 1, recipe.seed)
    batch = next(stream)
    stream.close()
    one = slice(0, 1)
    objective(batch.inputs.to(device), batch.targets.select(one).to(device)).total.backward()
    objective.zero_grad()
    before = restart_peak(device)
    outcome = objective(batch.inputs.to(device), batch.targets.to(device))
    outcome.total.backward()
    assert all(p.grad is not None for p in objective.parameters())
    return {"before": before, "peak": peak(device)}


def restart_peak(device: str) -> float:
    """Forget the peak so far; MB held now."""
    if device == "cuda":
        torch.cuda.reset_peak_memory_stats()
        return torch.cuda.memory_allocated() / 1e6
    Path("/proc/self/clear_refs").write_text("5")
    return megabytes("VmRSS")


def peak(device: str) -> float:
    """MB at the peak since `restart_peak`."""
    return torch.cuda.max_memory_allocated() / 1e6 if device == "cuda" else megabytes("VmHWM")


def in_own_process(views: int, render_views: int, device: str) -> dict[str, float]:
    command = [sys.executable, __file__, "--alone", str(views), str(render_views), device]
    environment = {**os.environ, "MALLOC_MMAP_THRESHOLD_": "65536"}
    done = subprocess.run(command, check=True, capture_output=True, text=True, env=environment)
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--views", type=int, nargs=2, default=[2, 16], metavar=("FEW", "MANY"))
    parser.add_argument("--render-views", type=int, default=2)
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
    parser.add_argument("--alone", nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.alone:
        views, render_views, device = options.alone
        print(json.dumps(step_memory(int(views), int(render_views), device)))
        return
    print(f"{QUERIES * GAUSSIANS_PER_QUERY} Gaussians, {SIDE} x {SIDE} pixels, MB")
    for render_views in (0, options.render_views):
        found = [in_own_process(views, render_views, options.device) for views in options.views]
        for views, memory in zip(options.views, found, strict=True):
            step = memory["peak"] - memory["before"]
            name = f"render_views {render_views}, {views:2} target views"
            print(f"{name}: peak {memory['peak']:7.1f}, step {step:7.1f}")
        few, many = found
        steps = [memory["peak"] - memory["before"] for memory in (few, many)]
        print(f"  ratio: peak {many['peak'] / few['peak']:.2f}, step {steps[1] / steps[0]:.2f}")


if __name__ == "__main__":
    main()
