"""Which components may stand together: fields, layers of other builds, options without effect."""

from typing import Any, ClassVar

import pytest

from qgs.components import MultiViewViT
from qgs.composer import RecipeError, resolve
from qgs.contracts import (
    CONTRACT_VERSION,
    MEMORY_FIELDS,
    DecoderLayer,
    Fields,
    FieldSpec,
    Loss,
    Plugin,
    Queries,
    Refinement,
)
from qgs.contracts.head import GAUSSIAN_FIELDS

PLACE = {"place": FieldSpec((3,))}


class Start(Queries):
    name: ClassVar[str] = "start"
    reads: ClassVar[Fields] = {"memory.grid": MEMORY_FIELDS["memory.grid"]}
    writes = PLACE


class Keep(Refinement):
    name: ClassVar[str] = "keep"
    reads = writes = PLACE


class Late(Refinement):
    name: ClassVar[str] = "late"
    writes = PLACE


class Joint(DecoderLayer):
    name: ClassVar[str] = "joint"
    reads_layer_scale = False
    reads: ClassVar[Fields] = {"memory.features": MEMORY_FIELDS["memory.features"]}


class Placed(Joint):
    name: ClassVar[str] = "placed"
    reads = PLACE


class Blind(MultiViewViT):
    name: ClassVar[str] = "blind"
    writes: ClassVar[Fields] = {"memory.features": FieldSpec((32,))}


class FeatureLoss(Loss):
    name: ClassVar[str] = "features"
    reads: ClassVar[Fields] = {"gaussians.features": GAUSSIAN_FIELDS["gaussians.features"]}


COMPONENTS = (Start, Keep, Late, Joint, Placed, Blind, FeatureLoss)
PLUGIN = Plugin("mine", CONTRACT_VERSION, COMPONENTS)
JOINT, PLACED = {"type": "mine/joint"}, {"type": "mine/placed"}
START, KEEP, LATE = ({"type": f"mine/{name}"} for name in ("start", "keep", "late"))
LATENTS = {"type": "tokengs2026/latent_bottleneck", "depth": 1, "blocks": [1], "latents": 5}
NO_LAYERS = {"decoder": {"depth": 0}, "supervision": {"layers": [0]}}


def problems_of(recipe: dict[str, Any] | None = None, **model: Any) -> list[tuple[str, str]]:
    """Option, and reason and fix, of all problems of a small recipe."""
    small = {"width": 16, "heads": 2, "decoder": {"depth": 2}, "supervision": {"layers": [2]}}
    given = {
        "recipe": 1,
        "plugins": ["mine", "tokengs2026"],
        "model": small | model,
        **(recipe or {}),
    }
    try:
        first = resolve(given, plugins=[PLUGIN]).tree
    except RecipeError as error:
        return [(p.option, f"{p.reason}; {p.fix}") for p in error.problems]
    assert resolve(first, plugins=[PLUGIN]).tree == first, "a resolved recipe resolves to itself"
    return []


@pytest.mark.parametrize(
    ("model", "option", "words"),
    [
        ({"queries": START}, "", []),
        ({"queries": START, "decoder": {"depth": 2, "refinement": KEEP}}, "", []),
        ({"decoder": {"depth": 2, "layer": JOINT}}, "", []),
        ({"decoder": {"depth": 2, "layer": JOINT, "self_attention": None}}, "", []),
        ({"decoder": {"depth": 2, "layers": {"1": {"layer": JOINT}}}}, "", []),
        (NO_LAYERS, "", []),
        # A component that reads a field is no provider of it.
        (
            {"decoder": {"depth": 2, "refinement": KEEP}},
            "model.decoder.refinement",
            ["needs place", "`mine/start` in the slot `queries`"],
        ),
        (
            {"decoder": {"depth": 2, "layer": PLACED, "refinement": LATE}},
            "model.decoder.layer",
            ["needs place", "`mine/late` at model.decoder.refinement", "too late", "`mine/start`"],
        ),
        ({"queries": START, "encoder": LATENTS}, "model.queries", ["memory.grid", "multiview"]),
        (
            {"encoder": {"type": "mine/blind"}},
            "model.decoder.cross_attention",
            ["memory.keys", "memory.values"],
        ),
        (
            {"encoder": {"type": "mine/blind"}, "decoder": {"depth": 2, "layer": JOINT}},
            "model.decoder.layer",
            ["reads memory.features as D float32", "`mine/blind` at model.encoder", "as 32 float"],
        ),
        (
            {"decoder": {"depth": 2, "layer": JOINT, "self_attention": {"type": "qgs/content"}}},
            "model.decoder.self_attention",
            ["`mine/joint`", "no slot `self_attention`"],
        ),
        (
            {"decoder": {"depth": 2, "layers": {"1": {"layer": JOINT, "feed_forward": {}}}}},
            "model.decoder.layers.1.feed_forward",
            ["`mine/joint`"],
        ),
        (
            {**NO_LAYERS, "decoder": {"depth": 0, "feed_forward": {"ratio": 2}}},
            "model.decoder.feed_forward",
            ["depth 0"],
        ),
        ({"decoder": {"depth": 0}}, "model.supervision.layers", ["[2]", "[0]"]),
        ({"supervision": {"layers": [0]}}, "model.supervision.layers", ["1 to 2"]),
        (
            {"decoder": {"depth": 2, "layer_scale": 0.5, "layer": JOINT}},
            "model.decoder.layer_scale",
            ["`mine/joint`"],
        ),
        (
            {**NO_LAYERS, "decoder": {"depth": 0, "layer_scale": 0.5}},
            "model.decoder.layer_scale",
            ["depth 0"],
        ),
        ({"decoder": {"depth": 2, "layer_scale": 0.5, "layers": {"1": {"layer": JOINT}}}}, "", []),
    ],
)
def test_components_that_stand_together(model: Any, option: str, words: list[str]) -> None:
    found = problems_of(**model)
    assert [path for path, _ in found] == ([option] if option else [])
    assert [word for word in words if word not in found[0][1]] == []


def test_a_template_that_one_layer_reads_is_not_idle() -> None:
    decoder = {"depth": 2, "feed_forward": {"ratio": 2.0}, "layers": {"0": {"layer": JOINT}}}
    assert problems_of(decoder=decoder) == []


def test_a_loss_on_features_needs_a_head_that_gives_them() -> None:
    ((option, text),) = problems_of({"losses": {"mine": {"type": "mine/features"}}})
    assert option == "losses.mine"
    assert "gaussians.features" in text


@pytest.mark.parametrize(
    ("changed", "sound"),
    [
        ({"views": {"pose_noise": 1.0}}, {"views": {"pose_noise": 0.0}}),
        ({"evaluation": {"tuning": "latents"}}, {"evaluation": {"tuning": "queries"}}),
    ],
)
def test_settings_that_contradict_each_other(changed: Any, sound: Any) -> None:
    judged = {"training": {"judge_inputs": True}} if "views" in changed else {}
    ((option, _),) = problems_of(judged | changed)
    assert option == ("training.judge_inputs" if judged else "evaluation.tuning")
    assert problems_of(judged | sound) == []
    assert problems_of(judged) == []


def test_images_that_are_too_small_for_a_loss() -> None:
    data = {"type": "qgs/photos", "path": "x", "image_size": [8, 16]}
    losses = {"mine": {"type": "qgs/photometric", "padding": "valid"}}
    ((option, _),) = problems_of({"losses": losses, "data": data})
    assert option.startswith("losses.mine")
    assert problems_of({"losses": losses, "data": {**data, "image_size": [16, 16]}}) == []


def test_an_unread_field_of_the_queries_is_a_warning() -> None:
    model = {"queries": START, "decoder": {"refinement": KEEP}}
    recipe = {"recipe": 1, "plugins": ["mine"], "model": model}
    (warning,) = resolve(recipe, plugins=[PLUGIN]).warnings
    assert "nothing reads place" in warning
