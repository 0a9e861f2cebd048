"""Evaluation indices: what is read, what is refused, which samples they name."""

from unittest.mock import Mock

import torch
from line_scenes import Line, Lines, plan_of, samples_of
from photo_formats import cut, opened, synthetic, write_nerfstudio
from tables import assert_equal, assert_near, must_refuse, rows, write_json

from qgs.contracts import EvaluationConfig, ViewsConfig
from qgs.evaluate.plan import read_index

VIEWS = ViewsConfig(inputs=2, gap=(2, 5))


def entry(context, target):
    return {"context": context, "target": target}


def indexed(folder, index, **options):
    """Settings of an evaluation on the views of an index."""
    file = folder / "index.json"
    write_json(file, index)
    return EvaluationConfig(index=str(file), **options)


REFUSED = """
{"a": {"context": [0]}} | a.target: Field required
{"a": {"context": [], "target": [1]}} | a.context: List should have at least 1 item
{"a": {"context": ["0"], "target": [1]}} | a.context.0: Input should be a valid int
{"a": {"context": [0.5], "target": [1]}} | a.context.0: Input should be a valid int
["a"] | file: Input should be a valid dictionary
{"a": null} | names no scene to score
{"a": | Expecting value
"""


def test_other_files_are_refused_with_the_reason(tmp_path):
    file = tmp_path / "index.json"
    for text, reason in rows(REFUSED):
        file.write_text(text)
        must_refuse(reason, read_index, str(file))


def test_samples_are_those_of_the_index_in_its_order(tmp_path):
    """Of a published one, with more numbers and scenes that cannot be judged."""
    source = Lines(*(Line(8, name=name) for name in ("one", "two", "three")))
    three = {**entry([4, 1], [2, 3, 2]), "overlap": 0.5}
    index = {"three": three, "two": None, "one": entry([0, 7], [5])}
    first, second = samples_of(source, VIEWS, indexed(tmp_path, index, scenes=1))
    assert first.scene == "three"
    assert second.scene == "one"
    assert first.input_frames == (4, 1)
    assert first.target_frames == (2, 3, 2)
    assert_near(first.targets.images[0, :, 0, 0, 0], [0.02, 0.03, 0.02])
    assert_equal(first.inputs.cameras.c2w[0, 0], torch.eye(4))


def test_damaged_photo_folders_are_named_and_positions_never_move_in_silence(tmp_path):
    photos = synthetic(tmp_path / "photos", 5)
    sets = tmp_path / "sets"
    index = {name: entry([0, 3], [2]) for name in ("broken", "cut", "gap", "good")}
    for name in index:
        write_nerfstudio(sets / name, photos)
    (sets / "broken/transforms.json").write_text("{")
    cut(sets / "cut/images/view_002.png", 0.1)
    (sets / "gap/images/view_001.png").unlink()
    plan = plan_of(opened(sets, (16, 16)), VIEWS, indexed(tmp_path, index))
    assert plan.wanted == tuple(index)
    assert len(list(plan.samples("good"))) == 1
    reasons = {
        "broken": r"transforms\.json",
        "cut": r"view_002\.png",
        "gap": r"1 images of the scene do not exist.*view_001\.png",
    }
    for scene, reason in reasons.items():
        must_refuse(reason, list, plan.samples(scene), kind=(ValueError, OSError))


def test_scenes_are_decoded_one_at_a_time():
    scenes = [Line(8, name=f"scene{n}") for n in range(4)]
    for scene in scenes:
        scene.images = Mock(wraps=scene.images)
    plan = plan_of(Lines(*scenes), VIEWS, EvaluationConfig())
    for number, name in enumerate(plan.wanted):
        assert len(list(plan.samples(name))) == 1
        decoded = [scene.images.call_count for scene in scenes]
        assert decoded == [1] * (number + 1) + [0] * (3 - number)
