"""What `qgs bench --predict` counts for a training step against the peak of a process that does it.

    python tools/bench_predictor.py [--threads 1]

On the CPU, each step in a fresh process: the counted tensors, the prediction (with process and
reserve, without what `qgs train` holds besides), and the largest resident set: as it is, and with
MALLOC_MMAP_THRESHOLD_, with which glibc gives back what is freed. Prints Markdown.
"""

import argparse
import os

import torch
from qgs_bench.memory import peak_memory
from qgs_bench.predict import need_of
from qgs_bench.work import workload_of

from qgs.composer import resolve

MIDDLE = ("model.width=384", "model.heads=6", "model.queries.count=1024", "model.decoder.depth=6")
GIVES_BACK = "MALLOC_MMAP_THRESHOLD_"
CASES = [
    ("tiny/tokengs.yaml", (), (64, 64), 2, "float32"),
    ("tiny/locus.yaml", (), (64, 64), 8, "float32"),
    ("tiny/locus.yaml", (), (64, 64), 32, "float32"),
    ("tiny/ellipsoid.yaml", (), (256, 256), 1, "float32"),
    ("tiny/c3g.yaml", (), (128, 128), 4, "float32"),
    ("tiny/gslrm.yaml", (), (256, 256), 1, "bf16"),
    ("tiny/globalsplat.yaml", (), (128, 128), 8, "float32"),
    ("tokengs/dl3dv_4096_4views.yaml", MIDDLE, (128, 128), 2, "float32"),
    ("locus/dl3dv_4096_4views.yaml", MIDDLE, (128, 128), 1, "float32"),
    ("locus/dl3dv_4096_4views.yaml", MIDDLE, (256, 256), 1, "bf16"),
]
"""Recipe, changes, size of the photos, batch, precision."""


def main() -> None:
    parser = argparse.ArgumentParser(description="The predictor of memory against measured peaks.")
    parser.add_argument("--threads", type=int, default=1)
    torch.set_num_threads(parser.parse_args().threads)
    print(
        "| recipe | batch x views x size | precision | tensors | predicted | measured | error "
        "| gives back | error |"
    )
    print("|---|---|---|--:|--:|--:|--:|--:|--:|")
    for name, changes, size, batch, precision in CASES:
        middle = name.partition("/")[0] in ("tokengs", "locus")
        layers = "[3, 6]" if name.startswith("locus") else "[6]"
        supervised = [f"model.supervision.layers={layers}"] if middle else []
        recipe = resolve(name, [*changes, *supervised])
        work = workload_of(recipe, size=size, batch=batch, precision=precision)
        need = need_of(recipe, work)
        predicted = sum(need.step.values())
        os.environ.pop(GIVES_BACK, None)
        cells = [f"{need.tensors / 2**20:,.0f} MiB", f"{predicted / 2**20:,.0f} MiB"]
        for _ in range(2):
            peak = peak_memory(recipe, "step", work, torch.get_num_threads()).peak_bytes
            cells += [f"{peak / 2**20:,.0f} MiB", f"{100 * (predicted / peak - 1):+.1f} %"]
            os.environ[GIVES_BACK] = str(2**20)
        shape = f"{batch} x {work.views} x {size[0]} x {size[1]}"
        label = f"`{name}`{', smaller' if middle else ''}"
        print(f"| {label} | {shape} | {precision} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
