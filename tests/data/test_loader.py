"""Training batches: one stream, whoever decodes it and however many share it."""

import multiprocessing
import threading

import pytest
import torch
from line_scenes import Line, Lines
from photo_formats import cut, synthetic, write_nerfstudio
from tables import assert_equal, must_refuse
from training_runs import batches, stream_of, tiny

from qgs.containers import named_tensors
from qgs.contracts import ViewsConfig
from qgs.data.stream import SampleError, SampleStream, scenes_fingerprint, training_batches
from qgs.recipe import resolve

ROOMS = resolve("tiny/tokengs.yaml", ["data={image_size: [16, 16], scenes: 5, samples: 1}"])
SAMPLES = stream_of(ROOMS)


def photos(folder):
    """Of the last photo only a part is there."""
    write_nerfstudio(folder, synthetic(folder.with_name("photos"), 8))
    cut(folder / "images/view_007.png", 0.1)
    data = f"data={{type: qgs/photos, path: {folder}, image_size: [16, 16], holdout: 0}}"
    return resolve(ROOMS.tree, [data, "views.gap=[4, 4]"])


def assert_same(first, second):
    for a, b in zip(first, second, strict=True):
        assert a.scenes == b.scenes
        assert_equal(*(dict(named_tensors([batch.inputs, batch.targets])) for batch in (a, b)))


def test_running_out_of_memory_is_no_bad_sample(tmp_path, monkeypatch):
    def full(*_):
        raise MemoryError

    monkeypatch.setattr("qgs.data.images.eight_bits", full)
    with pytest.raises(MemoryError):
        batches(stream_of(photos(tmp_path / "shelf"), skips=True), 1, 2)


def test_worker_processes_change_nothing_and_end_with_an_error_that_names_the_file(tmp_path):
    recipe = photos(tmp_path / "shelf")

    def until_broken(start, workers):
        stream = training_batches(stream_of(recipe, 3), 1, start, workers=workers)
        found = []

        def follow():
            for batch in stream:
                assert len(multiprocessing.active_children()) == workers
                found.append(batch)

        must_refuse(r"'shelf': .*7\.png", follow, kind=SampleError)
        assert not multiprocessing.active_children()
        return found

    here = until_broken(0, 0)
    state = torch.get_rng_state()
    assert len(here) > 3
    assert_same(here[2:], until_broken(2, 2))
    assert_equal(torch.get_rng_state(), state)


def test_reading_ahead_leaves_the_autocast_of_training_alone():
    """Threads share the cache of cast weights; a thread that empties it changes gradients."""
    weight = torch.eye(4, requires_grad=True)
    x = torch.ones(1, 4)
    with torch.autocast("cpu", torch.bfloat16):
        first = torch.nn.functional.linear(x, weight).grad_fn
        batches(SAMPLES, 2, 1)
        second = torch.nn.functional.linear(x, weight).grad_fn
    one, other = (node.next_functions[-1][0].next_functions[0][0] for node in (first, second))
    assert one is other


def test_closing_ends_the_thread():
    batches(SAMPLES, 1, 1)
    assert not [t for t in threading.enumerate() if t.name.startswith("qgs-loader")]


def test_processes_share_what_one_would_see():
    processes = 3
    alone = batches(SAMPLES, 3, 2 * processes)
    assert len({*alone[0].scenes[:5]}) == 5, "an epoch visits every scene once"
    assert alone[0].inputs.images.is_contiguous()
    for rank in range(processes):
        own = {"rank": rank, "processes": processes}
        part = batches(SAMPLES, 3, 2, **own)
        place = slice(2 * rank, 2 * rank + 2)
        for whole, ours in zip(alone, part, strict=True):
            assert ours.scenes == whole.scenes[place]
            assert_equal(ours.inputs.images, whole.inputs.images[place])
            assert_equal(ours.targets.cameras.c2w, whole.targets.cameras.c2w[place])
        assert_same(batches(SAMPLES, 1, 2, **own, start=2), part[2:])


def test_samples_of_a_step_have_one_image_size_and_one_number_of_inputs():
    sizes = [(8, 24), (24, 8)]
    recipe = tiny(
        "tokengs", f"training.image_sizes={[*map(list, sizes)]}", "view_sampler.extra_inputs=2"
    )
    samples = stream_of(recipe, per_step=2, sizes=sizes)

    seen = batches(samples, 12, 1)
    shapes = [batch.inputs.images.shape for batch in seen]
    assert shapes[::2] == shapes[1::2]
    assert [shape[1] for shape in shapes[::2]] == [2, 3, 4, 2, 3, 4]
    assert {tuple(shape[3:]) for shape in shapes} == {*sizes}
    for batch in seen:
        assert batch.inputs.cameras.size == batch.inputs.images.shape[3:]
    assert_same(seen[5:], batches(samples, 7, 1, start=5, workers=1))


class Grouped(Lines):
    """Scenes of equal cameras, stored in groups."""

    def __init__(self, count, groups):
        super().__init__(*(Line(4, name=str(index)) for index in range(count)))
        self._groups = groups

    def groups(self, split):
        return self._groups


def test_groups_are_visited_one_after_another_in_changing_orders():
    groups = [range(3), range(3, 6), [8, 6, 7]]
    samples = SampleStream(Grouped(9, groups), ViewsConfig(inputs=2, targets=1, gap=(1, 3)), 0)
    stream = training_batches(samples, 9)
    epochs = [[int(name) for name in next(stream).scenes] for _ in range(20)]
    for epoch in epochs:
        parts = [frozenset(epoch[i : i + 3]) for i in (0, 3, 6)]
        assert set(parts) == {frozenset(group) for group in groups}
    assert {epoch[0] for epoch in epochs} == set(range(9)), "groups and scenes in them vary"


def test_fingerprints_tell_stores_apart():
    stores = ([range(6)], [range(3), range(3, 6)], [range(4), range(4, 6)])
    assert len({scenes_fingerprint(Grouped(6, groups)) for groups in stores}) == 3
    alike = ([[0, 1]], [range(2)], [range(2), []])
    assert len({scenes_fingerprint(Grouped(2, groups)) for groups in alike}) == 1
