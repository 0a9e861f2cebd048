"""Runs of tiny models, for the tests of training."""

import json
from contextlib import closing
from functools import partial
from itertools import islice

import pytest
import torch
from rich.console import Console
from tables import assert_equal

from qgs.data.stream import SampleError, SampleStream, training_batches
from qgs.recipe import resolve
from qgs.train.folder import RunFolder, read_state
from qgs.train.tracking import TrainingProgress
from qgs.train.training import Trainer, train

SMALL = """
model.width=32 model.heads=2 model.queries.count=24
model.decoder.depth=2 model.supervision.layers=[1,2] model.head.gaussians_per_query=4
data.image_size=[16,16] views.targets=2 evaluation.scenes=2
training.steps=3 training.seconds=null optimizer.warmup=2
"""
QUIET = Console(quiet=True)
TRAINED = "training={ema: 0.5, evaluate_every: 2}"
TWO = (
    "plugins=[rooms, locus, globalsplat]",
    "objective.type=globalsplat/two_passes",
    "views.inputs=5",
)
"""Train on two passes of the model."""


def tiny(name, *overrides):
    """A recipe of recipes/tiny, smaller yet, with overrides."""
    return resolve(f"tiny/{name}.yaml", [*SMALL.split(), *overrides])


def run(recipe, folder="run", device="cpu", **options):
    return train(recipe, folder, console=QUIET, device=device, **options)


resume = partial(run, resume=True)


@pytest.fixture(scope="session")
def trained_run(tmp_path_factory):
    """A finished run of `tiny("locus", TRAINED)`, 3 steps; a test that changes it takes a copy."""
    torch.set_num_threads(1)
    return run(tiny("locus", TRAINED), tmp_path_factory.mktemp("trained") / "run")


def run_calling(after_step, recipe, folder="run", resume=False):
    """A run that calls `after_step(trainer, stop)` after each step."""
    stop = []

    class Calling(TrainingProgress):
        def show(self, *_):
            after_step(trainer, stop)

    with closing(Trainer(recipe, folder, resume=resume)) as trainer:
        return trainer.run(Calling(QUIET), stop)


def parts_of(folder="run"):
    """What the saved state of a run holds, by part."""
    return read_state(RunFolder(folder).state)[1]


def saved_step(folder="run"):
    return parts_of(folder)["counters"]["step"]


def assert_equal_runs(first, second):
    """Same weights, optimiser state and random states to the bit, same history but for time."""
    ours = parts_of(first)
    theirs = parts_of(second)
    assert untimed(ours, first) == untimed(theirs, second)
    assert_equal(ours, theirs)


def untimed(parts, folder):
    """All but tensors, which stay in the parts, and times."""
    told = parts.pop("counters"), parts.pop("guard"), *RunFolder(folder).history()
    return [{**record, "seconds": 0} for record in told]


def stream_of(recipe, seed=0, **options):
    """The samples of a training."""
    sampler = recipe.build_view_sampler()
    return SampleStream(recipe.build_data(), recipe.views, seed, sampler=sampler, **options)


def batches(samples, count, size, **options):
    """The first training batches of a stream."""
    with closing(training_batches(samples, size, **options)) as stream:
        return list(islice(stream, count))


def losses(run="run"):
    return column(RunFolder(run).history(), "loss")


def column(records, name):
    return [record[name] for record in records]


def read_jsonl(path):
    """The records of a JSONL file, each strictly JSON."""
    lines = path.read_text().splitlines()
    return [json.loads(line, parse_constant=pytest.fail) for line in lines]


def change_samples(monkeypatch, change):
    """`change(sample, number, attempt)` alters each training sample in place, or raises."""
    made = SampleStream._sample_after

    def changed(stream, number, attempt):
        sample = made(stream, number, attempt)
        change(sample, number, attempt)
        return sample

    monkeypatch.setattr(SampleStream, "_sample_after", changed)


def spoil(monkeypatch, bad, nan=False):
    """Samples of numbers in `bad`, with those that replace others, have a bad pixel or fail."""

    def spoiled(sample, number, attempt):
        number += attempt
        if number in bad:
            if not nan:
                raise SampleError(f"scene 'x', frame {number} (a.png): cannot be read")
            sample.targets.images[0, 0, 0, 0, 0] = torch.nan

    change_samples(monkeypatch, spoiled)
