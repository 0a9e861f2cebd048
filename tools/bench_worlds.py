"""Seconds that `worlds/procedural` takes for its scenes, against `rooms/procedural`, in turn.

    python tools/bench_worlds.py [--scenes 60] [--side 64]

Time of the process on one thread, summed over scenes of 8 views, none from the cache.
"""

import argparse
import time

import numpy as np
import torch
from qgs_worlds.rooms.source import RoomsConfig, RoomsSource
from qgs_worlds.source import WorldsConfig, WorldsSource

from qgs.contracts import Scene


def seconds(scene: Scene) -> float:
    start = time.process_time()
    scene.images(range(len(scene)))
    return time.process_time() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=60)
    parser.add_argument("--side", type=int, default=64)
    options = parser.parse_args()
    torch.set_num_threads(1)
    size = (options.side, options.side)
    rooms = RoomsSource(RoomsConfig(image_size=size, cache_mb=0)).scenes("train")
    worlds = WorldsSource(WorldsConfig(image_size=size, cache_mb=0)).scenes("train")
    warm = 3
    pairs = [[seconds(rooms[i]), seconds(worlds[i])] for i in range(options.scenes + warm)][warm:]
    room, world = np.sum(pairs, 0)
    views = 8 * len(pairs)
    print(f"rooms  {views / room:.0f} views a second\nworlds {views / world:.0f} views a second")
    print(f"worlds {room / world:.2f} of the views of rooms")


if __name__ == "__main__":
    main()
