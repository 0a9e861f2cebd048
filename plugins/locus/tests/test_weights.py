"""LocusGS's published layout: sizes and variants are read off names and shapes."""

from collections.abc import Iterable

import pytest
from qgs_locus.weights import LOCUSGS

import qgs
from qgs.contracts import LayoutError
from qgs.contracts.weights import Shapes

MODEL = {
    "width": 48,
    "heads": 3,
    "encoder": {"patch_size": 4, "depth": 2, "mlp_ratio": 3},
    "queries": {"type": "locus/anchored", "count": 10},
    "decoder": {
        "depth": 3,
        "cross_attention": {"type": "locus/ray_biased"},
        "self_attention": {"type": "locus/anchor_aware"},
        "feed_forward": {"ratio": 2},
        "refinement": {"type": "locus/refine"},
    },
    "head": {"gaussians_per_query": 5},
    "centers": {"type": "locus/radius_scaled"},
    "supervision": {"layers": [2, 3]},
}
RECIPE = {"recipe": 1, "plugins": ["locus"], "model": MODEL}
FIXED_CENTERS = ("model.queries.radius=false", "model.decoder.refinement.radius=false",
                 "model.decoder.cross_attention.bandwidth=fixed",
                 "model.centers={type: locus/anchor_offset}")  # fmt: skip


def published_shapes(*overrides: str) -> dict[str, tuple[int, ...]]:
    state = qgs.compose(RECIPE, overrides, device="meta").state_dict()
    names = {ours: LOCUSGS.published_name(ours) for ours in state}
    assert None not in names.values()
    return {str(names[ours]): tuple(tensor.shape) for ours, tensor in state.items()}


@pytest.mark.parametrize(
    "overrides",
    [
        (),
        FIXED_CENTERS,
        ("model.decoder.refinement.radius=false",),
        ("model.decoder.cross_attention={type: qgs/content}",),
        ("model.decoder.self_attention={type: qgs/content}",),
        ("model.encoder.depth=0", "model.encoder.mlp_ratio=4"),
    ],
)
def test_the_recipe_that_is_read_makes_the_same_model(overrides: tuple[str, ...]) -> None:
    shapes = published_shapes(*overrides)
    model = qgs.compose(LOCUSGS.read(shapes), device="meta")
    assert {
        str(LOCUSGS.published_name(name)): tuple(tensor.shape)
        for name, tensor in model.state_dict().items()
    } == shapes
    own = qgs.compose(RECIPE, overrides, device="meta").recipe
    read = model.recipe
    assert own is not None
    assert read is not None
    assert read["model"] == own["model"]


def unused_beside(names: Iterable[str]) -> list[str]:
    found = (rule.renamed(name) for name in names for rule in LOCUSGS.unused)
    return [name for name in found if name is not None]


def test_what_is_never_read_stands_beside_what_is() -> None:
    full = published_shapes()
    unused = unused_beside(full)
    assert len(unused) == 3 * 9
    assert not set(unused) & set(full)
    content = published_shapes("model.decoder.cross_attention={type: qgs/content}")
    assert len(unused_beside(content)) == 3 * 8


def test_only_its_own_files_have_its_marks() -> None:
    assert set(LOCUSGS.marks) <= set(published_shapes())
    assert not set(LOCUSGS.marks) <= {"gs_tokens", "patch_embed.proj.weight"}


def without(shapes: Shapes, name: str) -> Shapes:
    return {key: shape for key, shape in shapes.items() if key != name}


def test_shapes_without_a_recipe_are_refused() -> None:
    shapes = published_shapes()
    with pytest.raises(LayoutError, match="gs_tokens is missing"):
        LOCUSGS.read(without(shapes, "gs_tokens"))
    with pytest.raises(LayoutError, match="channels of the head: 71 is no multiple of 14"):
        LOCUSGS.read({**shapes, "activation_head.deconv.weight": (71, 48)})
    with pytest.raises(LayoutError, match="no size can be read"):
        LOCUSGS.read({**shapes, "gs_tokens": (10,)})
