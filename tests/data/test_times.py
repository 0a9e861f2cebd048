"""Scenes that move: times in transforms files and chunks, what is drawn of them, a training."""

import io
import json
import sys
import tarfile

import kubric_to_photos
import numpy as np
import pytest
import torch
from commands import run_qgs
from line_scenes import Line, Lines
from PIL import Image
from qgs_datasets.chunks import ChunksSource
from qgs_datatools.packing import own_splits, pack
from tables import fault
from training_runs import run
from upath import UPath

from qgs.composer import RecipeError, resolve
from qgs.contracts import EvaluationConfig, ViewsConfig
from qgs.data import PhotosSource
from qgs.data.evaluation import evaluation_samples, held_out_windows
from qgs.data.samples import collate, draw_frames, make_sample

VIEWS = ViewsConfig(inputs=2, targets=2, gap=(2, 4))


class Moving(Line):
    """`cameras` at each time, by time: frame 0 is the first of time 0."""

    def __init__(self, times, cameras, held_out=()):
        super().__init__(times * cameras, held_out, name=f"moving{times}x{cameras}")
        self.times = torch.arange(times).double().repeat_interleave(cameras) / 10


def dnerf(folder, times, cameras=1):
    """A folder as D-NeRF's: a transforms file for each split, a square that moves over time."""
    for part, of_part in times.items():
        (folder / part).mkdir(parents=True)
        frames = []
        for number, time in enumerate(of_part):
            image = np.full((16, 16, 3), 40, np.uint8)
            at = int(8 * time) if isinstance(time, int | float) and 0 <= time <= 1 else 0
            image[4:10, at : at + 6] = [200, 90, 30]
            Image.fromarray(image).save(folder / part / f"r_{number:03d}.png")
            pose = np.eye(4)
            pose[:3, 3] = 0.2 * (number % cameras) + 0.05 * number, 0, 2
            entry = {"file_path": f"./{part}/r_{number:03d}", "transform_matrix": pose.tolist()}
            frames.append(entry if time is None else {**entry, "time": time})
        content = {"camera_angle_x": 0.9, "frames": frames}
        (folder / f"transforms_{part}.json").write_text(json.dumps(content))
    return folder


def photos(folder):
    options = {"path": str(folder), "image_size": (16, 16)}
    return PhotosSource(PhotosSource.Config.model_validate(options))


def test_times_of_dnerf(tmp_path):
    folder = dnerf(tmp_path / "ball", {"train": [0, 0.25, 0.5], "test": [0.4]})
    (scene,) = photos(folder).scenes("train")
    assert scene.times is not None
    assert scene.times.dtype == torch.float64
    assert scene.times.tolist() == [0, 0.25, 0.5, 0.4]
    assert scene.held_out == (3,)
    still = dnerf(tmp_path / "still", {"train": [None] * 3})
    assert photos(still).scenes("train")[0].times is None
    equal = dnerf(tmp_path / "equal", {"train": [0.5] * 3})
    assert photos(equal).scenes("train")[0].times is None, "nothing moves in one moment"


def test_a_camera_that_stands_still_while_things_move_repeats_no_pose(tmp_path):
    folder = dnerf(tmp_path / "ball", {"train": [0, 0.5, 1], "test": [0.25]})
    for file in folder.glob("transforms_*.json"):
        content = json.loads(file.read_text())
        for frame in content["frames"]:
            frame["transform_matrix"][0][3] = float(frame["time"] > 0.4)
        file.write_text(json.dumps(content))

    assert "repeats" not in run_qgs("data", "check", folder, "--geometry", 0).output
    (file,) = folder.glob("transforms_test.json")
    file.write_text(file.read_text().replace("0.25", "0"))
    assert "repeats" in run_qgs("data", "check", folder, "--geometry", 0).output


def test_times_that_cannot_be(tmp_path):
    for number, time in enumerate([None, "noon", float("nan"), [1]]):
        folder = dnerf(tmp_path / str(number), {"train": [0, time, 0.5]})
        assert not fault("'time'", lambda path: photos(path).scenes("train")[0].cameras, folder)


def test_one_camera_a_time_gives_that_frame_as_all_targets():
    scene = Moving(12, 1)
    for seed in range(40):
        inputs, targets = draw_frames(scene, VIEWS, np.random.default_rng(seed))
        assert len(set(targets)) == 1
        assert len(targets) == 2
        assert inputs[0] < targets[0] < inputs[-1]


def test_several_cameras_a_time_give_targets_of_one_time_and_inputs_of_several_cameras():
    scene, asked, used = Moving(9, 4), set[float](), set[tuple[int, ...]]()
    assert scene.times is not None
    for seed in range(60):
        inputs, targets = draw_frames(scene, VIEWS, np.random.default_rng(seed))
        of_inputs, of_targets = scene.times[list(inputs)], scene.times[list(targets)]
        assert of_inputs[0] < of_inputs[1]
        assert 0.2 - 1e-9 <= of_inputs[1] - of_inputs[0] <= 0.4 + 1e-9
        assert len(set(of_targets.tolist())) == 1
        assert len({*targets, *inputs}) == 4, "targets are no inputs while there are others"
        assert of_inputs[0] <= of_targets[0] <= of_inputs[1]
        used.add(tuple(frame % 4 for frame in inputs))
        asked.add(float((of_targets[0] - of_inputs[0]) / (of_inputs[1] - of_inputs[0])))
    assert all(first != second for first, second in used)
    assert {0.0, 1.0, 0.5} <= {round(part, 6) for part in asked}


def test_times_go_from_0_to_1_and_ask_for_that_of_the_targets():
    sample = make_sample(Moving(10, 2), (2, 11), (6, 7), VIEWS, False)
    assert sample.inputs.times is not None
    assert sample.inputs.target_time is not None
    assert sample.inputs.times.tolist() == [[0, 1]]
    torch.testing.assert_close(sample.inputs.target_time, torch.tensor([[0.5]]))
    assert sample.inputs.times.dtype == torch.float32
    several = make_sample(Moving(10, 2), (2, 11), (4, 6), VIEWS, False)
    assert several.inputs.target_time is None, "two times cannot be asked for at once"
    still = make_sample(Line(9), (2, 6), (4,), VIEWS, False)
    assert still.inputs.times is None
    with pytest.raises(ValueError, match="line9"):
        collate([sample, still])


def test_targets_of_two_times_are_judged_apart():
    scene = Moving(10, 2, held_out=(6, 7, 9))
    windows = held_out_windows(scene, VIEWS)
    assert [targets for _, targets in windows] == [(6, 7, 9)]
    samples = list(evaluation_samples(Lines(scene), VIEWS, EvaluationConfig(scenes=5)))
    assert [sample.target_frames for sample in samples] == [(6, 7), (9,)]
    assert all(sample.inputs.target_time is not None for sample in samples)


def test_chunks_keep_times(tmp_path):
    source = photos(dnerf(tmp_path / "ball", {"train": [0, 0.5, 1 / 3], "test": [0.4]}))
    pack(source, own_splits(source), UPath(tmp_path / "packed"), {})
    options = {"path": str(tmp_path / "packed"), "image_size": (16, 16)}
    (scene,) = ChunksSource(ChunksSource.Config.model_validate(options)).scenes("train")
    given = source.scenes("train")[0]
    assert scene.times is not None
    assert given.times is not None
    assert torch.equal(scene.times, given.times)
    file = next((tmp_path / "packed" / "train").glob("*.torch"))
    (entry,) = torch.load(file)
    torch.save([{**entry, "times": torch.tensor([0, 1, float("nan"), 2])}], file)
    with pytest.raises(ValueError, match="'times'"):
        _ = ChunksSource(ChunksSource.Config.model_validate(options)).scenes("train")[0].cameras


DYNAMIC = (
    "plugins=[rooms, tokengs2026]",
    "model.encoder={type: tokengs2026/multiscale_vit, depth: 2, blocks: [2], time_channels: 2}",
    "model.queries={type: tokengs2026/dynamic, count: 64, dynamic: 16, std: 0.3, time_channels: 2}",
    "model.decoder.self_attention={type: tokengs2026/block_causal}",
    "objective={type: tokengs2026/dynamic, weight: 0.3}",
    "views.scale=constant",
    "training.steps=2",
    "training.seconds=null",
    "optimizer.warmup=1",
    "evaluation.scenes=1",
)


def test_a_dynamic_model_trains_on_photos_with_times(tmp_path):
    times = {"train": [i / 7 for i in range(8)], "test": [0.3]}
    folder = dnerf(tmp_path / "ball", times)
    data = f"data={{type: qgs/photos, path: {folder}, image_size: [16, 16]}}"
    recipe = resolve("tiny/tokengs.yaml", [*DYNAMIC, data])
    result = run(recipe, tmp_path / "run")
    assert result.steps == 2
    with pytest.raises(RecipeError, match="times"):
        resolve("tiny/tokengs.yaml", [*DYNAMIC])


def kubric_tar(file, camera, times):
    """One camera of a scene, in the layout that TokenGS 2026.6 reads."""
    half = 0.5**0.5
    positions = [[float(camera), 0.1 * time, 2.0] for time in range(times)]
    metadata = {
        "camera": {
            "focal_length": 35.0,
            "sensor_width": 32.0,
            "positions": positions,
            "quaternions": [[half, 0.0, 0.0, half]] * times,  # w first; 90 degrees about z
        }
    }
    with tarfile.open(file, "w") as archive:
        contents = {"metadata.json": json.dumps(metadata).encode()}
        for time in range(times):
            pixels = np.full((16, 16, 4), [10 * time, 20, 30, 0], np.uint8)
            stream = io.BytesIO()
            Image.fromarray(pixels).save(stream, "PNG")
            contents[f"rgba_{time:05d}.png"] = stream.getvalue()
        for name, content in contents.items():
            member = tarfile.TarInfo(f"./{name}")
            member.size = len(content)
            archive.addfile(member, io.BytesIO(content))


def test_kubric_becomes_photos_with_times(tmp_path, monkeypatch):
    (tmp_path / "v0" / "scn0").mkdir(parents=True)
    for camera in range(3):
        kubric_tar(tmp_path / "v0" / "scn0" / f"output_{camera:03d}.tar", camera, 4)
    monkeypatch.setattr(sys, "argv", ["kubric", str(tmp_path / "v0"), str(tmp_path / "photos")])
    kubric_to_photos.main()
    (scene,) = photos(tmp_path / "photos").scenes("train")
    assert scene.times is not None
    assert scene.times.tolist() == [0, 1, 2, 3] * 3
    assert scene.cameras.intrinsics[0].tolist() == pytest.approx([17.5, 17.5, 8, 8])
    c2w = torch.tensor([[0.0, 1, 0, 2], [1, 0, 0, 0.1], [0, 0, -1, 2], [0, 0, 0, 1]]).double()
    torch.testing.assert_close(scene.cameras.c2w[9], c2w)
    image = scene.images([6])[0, :, 8, 8].mul(255).round()
    assert image.tolist() == [20, 20, 30], "what is transparent stays as it is"
    views = ViewsConfig(inputs=2, targets=2, gap=(2, 3))
    inputs, targets = draw_frames(scene, views, np.random.default_rng(0))
    assert len({scene.times[frame].item() for frame in targets}) == 1
    assert {*inputs}.isdisjoint(targets)
    (tmp_path / "v0" / "scn1").mkdir()
    with tarfile.open(tmp_path / "v0" / "scn1" / "output_000.tar", "w"):
        pass
    with pytest.raises(SystemExit, match=r"output_000\.tar"):
        kubric_to_photos.main()
