"""Scenes that move: times in transforms files and chunks, what is drawn of them, a training."""

import numpy as np
import torch
from line_scenes import Line, Lines, drawn, samples_of
from photo_formats import scene, synthetic, write_blender
from tables import assert_equal, must_refuse
from torch.testing import assert_close
from training_runs import run

from qgs.contracts import EvaluationConfig, ViewsConfig
from qgs.data.samples import collate, make_sample
from qgs.evaluate.plan import held_out_windows
from qgs.recipe import resolve

VIEWS = ViewsConfig(inputs=2, targets=2, gap=(2, 4))


def moving(times, cameras, held_out=()):
    """A scene of `cameras` at each time, by time: frame 0 is the first of time 0."""
    taken = torch.arange(times).repeat_interleave(cameras) / 10
    return Line(times * cameras, held_out, times=taken[None])


def dnerf(folder, *times):
    """Noise as D-NeRF writes it, the last photo for a test; ... is no time."""
    files = synthetic(folder / "photos", len(times), (16, 16))
    files.c2w[:] = np.eye(4)
    return write_blender(folder / str(times), files, len(times) - 1, times=times)


def test_times_of_dnerf(tmp_path):
    read = scene(dnerf(tmp_path, 0, 0.25, 0.5, 0.4))
    assert read.times.dtype == torch.float64
    assert read.times.tolist() == [0, 0.25, 0.5, 0.4]
    assert read.held_out == (3,)
    assert scene(dnerf(tmp_path, *[...] * 4)).times is None
    assert scene(dnerf(tmp_path, *[0.5] * 4)).times is None, "nothing moves in one moment"


def test_times_that_cannot_be(tmp_path):
    for time in (..., None, "noon", float("nan"), [1]):
        must_refuse("'time'", scene, dnerf(tmp_path, 0, time, time))


def test_one_camera_a_time_gives_that_frame_as_all_targets():
    for seed in range(40):
        inputs, (target, same) = drawn(moving(12, 1), VIEWS, seed)
        assert inputs[0] < target == same < inputs[-1]


def test_several_cameras_a_time_give_targets_of_one_time_and_inputs_of_several_cameras():
    asked = set()
    for seed in range(60):
        inputs, targets = drawn(moving(9, 4), VIEWS, seed)
        assert len({*targets, *inputs}) == 4, "targets are no inputs while there are others"
        first, last = (frame // 4 for frame in inputs)
        assert last - first in (2, 3, 4)
        assert inputs[0] % 4 != inputs[1] % 4
        (time,) = {frame // 4 for frame in targets}
        asked.add((time - first) / (last - first))
    assert {0.0, 0.5, 1.0} <= asked <= {0, 0.25, 1 / 3, 0.5, 2 / 3, 0.75, 1}


def test_times_go_from_0_to_1_and_ask_for_that_of_the_targets():
    def made(scene, *frames):
        return make_sample(scene, *frames, VIEWS)

    sample = made(moving(10, 2), (2, 11), (6, 7))
    assert_equal(sample.inputs.times, torch.tensor([[0.0, 1]]))
    assert_close(sample.inputs.target_time, torch.tensor([[0.5]]))
    several = made(moving(10, 2), (2, 11), (4, 6)).inputs
    assert several.target_time is None, "two times cannot be asked for at once"
    still = made(Line(9), (2, 6), (4,))
    assert still.inputs.times is None
    must_refuse("line9", collate, [sample, still])


def test_targets_of_two_times_are_judged_apart():
    scene = moving(10, 2, held_out=(6, 7, 9))
    assert [targets for _, targets in held_out_windows(scene, VIEWS)] == [(6, 7, 9)]
    samples = samples_of(Lines(scene), VIEWS, EvaluationConfig(scenes=5))
    assert [sample.target_frames for sample in samples] == [(6, 7), (9,)]
    assert all(sample.inputs.target_time is not None for sample in samples)


DYNAMIC = """
plugins=[rooms, tokengs2026]
model.encoder={type: tokengs2026/multiscale_vit, depth: 2, blocks: [2], time_channels: 2}
model.queries={type: tokengs2026/dynamic, count: 64, dynamic: 16, std: 0.3, time_channels: 2}
model.decoder.self_attention={type: tokengs2026/block_causal}
objective={type: tokengs2026/dynamic, weight: 0.3}
views.scale=constant
training.steps=2
training.seconds=null
optimizer.warmup=1
evaluation.scenes=1
"""


def test_a_dynamic_model_trains_on_photos_with_times(here):
    folder = dnerf(here, *(i / 7 for i in range(8)), 0.3)
    data = f"data={{type: qgs/photos, path: '{folder}', image_size: [16, 16]}}"
    assert run(resolve("tiny/tokengs.yaml", [*DYNAMIC.strip().splitlines(), data])).steps == 2
