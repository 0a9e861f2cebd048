"""Share of a forward pass that is spent outside linear layers and attention, on the CPU.

    python tools/profile_forward.py RECIPE [--set a.b=c]... [--size 256x256] [--threads 2]

`qgs bench` has the seconds.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import qgs  # first: it asks for huge pages before torch allocates

# isort: split
import torch
from torch.profiler import ProfilerActivity, profile

from qgs.cli.options import parse_size
from qgs.composer import resolve
from qgs.engine.bench.work import workload_of

PRODUCTS = ("aten::addmm", "aten::mm", "aten::_scaled_dot_product_flash_attention_for_cpu")


def share_outside_products(model: qgs.QueryGaussianModel, views: qgs.Views) -> float:
    """Share of CPU time outside linear layers and scaled dot-product attention."""
    with torch.inference_mode():
        model(views)
        with profile(activities=[ProfilerActivity.CPU]) as profiled:
            model(views)
    times = {event.key: event.self_cpu_time_total for event in profiled.key_averages()}
    return 1 - sum(times.get(name, 0) for name in PRODUCTS) / sum(times.values())


def main() -> None:
    parser = argparse.ArgumentParser(description="Share outside linear layers and attention.")
    parser.add_argument("recipe", type=Path)
    parser.add_argument("--set", action="append", default=[], dest="overrides")
    parser.add_argument("--size")
    parser.add_argument("--threads", type=int, default=2)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    recipe = resolve(arguments.recipe, arguments.overrides)
    views = workload_of(recipe, size=parse_size(arguments.size)).inputs()
    share = share_outside_products(recipe.build_model().eval(), views)
    print(f"outside linear layers and attention: {share:.1%} of the CPU time")


if __name__ == "__main__":
    main()
