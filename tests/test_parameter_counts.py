"""Parameters of every published model at its published size, composed without allocating one."""

import re
from pathlib import Path

import pytest

import qgs

ROOT = Path(__file__).parents[1]
RECIPES = ROOT / "recipes"

D, N, LAYERS = 1024, 4096, 12
HEAD_OF_CENTERS = (D * D + D) + (D * 3 + 3)
HEAD_OF_RADII = (D * D + D) + (D + 1)
POSITION_MLPS = LAYERS * ((3 * 128 * D + D) + (D * D + D))
GAMMAS = LAYERS

TOKENGS = 222_016_768
UNUSED = 52_236
"""Parameters that the published LocusGS carries and never uses; there are none such here."""

LOCUSGS = 241_514_780 - UNUSED


LATENTS, READ = 4096, 4
HEAD_NORM = 2 * 64
EMBEDDINGS = (3 + 6) * 8 * 8 * D + 2 * (D + 2 * D)
MLP = (D * 4 * D + 4 * D) + (4 * D * D + D)
SELF_ATTENTION = (D * 3 * D + 3 * D) + (D * D + D) + 2 * HEAD_NORM
ENCODER_BLOCK = SELF_ATTENTION + MLP + 2 * (2 * D) + 2 * D
DECODER_BLOCK = (
    2 * (D * D + D) + HEAD_NORM + SELF_ATTENTION + MLP + 3 * (2 * D) + 3 * D
)  # as over the latents
READOUT = READ * 2 * D + (READ * D * 2 * D + 2 * D) + HEAD_NORM
OF_LATENTS = LATENTS * D + LAYERS * DECODER_BLOCK + (D * 2 * D + 2 * D) + HEAD_NORM
HEAD = D * 64 * 14 + 64 * 14

TOKENGS_2026_6 = 362_695_680
TIME_EMBEDDING = D * 2 * 8 * 8 + D
DYNAMIC = TOKENGS_2026_6 + (1024 + 256 - N) * D + 2 * TIME_EMBEDDING


GSLRM_BLOCK = (D * 3 * D + D * D) + 2 * (D * 4 * D) + 2 * D
GSLRM = (9 * 8 * 8 * D + D) + 24 * GSLRM_BLOCK + (D + D * 8 * 8 * (3 + 3 + 3 + 4 + 1))


def parameters(recipe: str) -> int:
    path = RECIPES / recipe
    model = qgs.compose(path, overrides=[f"model.queries.count={N}"], device="meta")
    assert {parameter.device.type for parameter in model.parameters()} == {"meta"}
    return sum(parameter.numel() for parameter in model.parameters())


@pytest.mark.parametrize("recipe", ["re10k_4096", "dl3dv_4096_4views", "dl3dv"])
def test_tokengs_and_locusgs(recipe: str) -> None:
    assert parameters(f"tokengs/{recipe}.yaml") == TOKENGS
    assert parameters(f"locus/{recipe}.yaml") == LOCUSGS


@pytest.mark.parametrize("loss", ["ssim", "lpips"])
@pytest.mark.parametrize("views", [2, 4, 6])
def test_tokengs_2026_6(views: int, loss: str) -> None:
    encoder = EMBEDDINGS + 12 * ENCODER_BLOCK + READOUT + OF_LATENTS
    assert encoder + N * D + DECODER_BLOCK + HEAD == TOKENGS_2026_6
    assert parameters(f"tokengs/latent_{views}views_{loss}.yaml") == TOKENGS_2026_6


def test_dynamic_tokengs() -> None:
    model = qgs.compose(RECIPES / "tokengs/dynamic.yaml", device="meta")
    assert sum(parameter.numel() for parameter in model.parameters()) == DYNAMIC == 360_076_288


@pytest.mark.parametrize("recipe", ["re10k", "dl3dv"])
def test_gslrm(recipe: str) -> None:
    """The paper: 300 million parameters in 24 blocks of width 1024."""
    model = qgs.compose(RECIPES / "gslrm" / f"{recipe}.yaml", device="meta")
    assert sum(parameter.numel() for parameter in model.parameters()) == GSLRM == 303_548_416


def test_what_locusgs_adds_to_tokengs() -> None:
    anchors = N * 3 + N * 1
    added = anchors + GAMMAS + POSITION_MLPS + HEAD_OF_CENTERS + HEAD_OF_RADII
    assert TOKENGS + added == LOCUSGS


@pytest.mark.parametrize(
    ("ablation", "without"),
    [
        ("reference", 0),
        ("no_radius_state", N * 1 + HEAD_OF_RADII),
        ("static_radius", HEAD_OF_RADII),
        ("content_self_attention", POSITION_MLPS),
        ("content_cross_attention", GAMMAS),
        # Only read differently: sigma without r, means without mu, means without r.
        ("center_only_bias", 0),
        ("free_centers", 0),
        ("anchor_offset", 0),
        ("supervised_12", 0),
        ("supervised_6_12", 0),
        ("supervised_3_6_9_12", 0),
    ],
)
def test_ablations(ablation: str, without: int) -> None:
    assert parameters(f"ablations/{ablation}.yaml") == LOCUSGS - without


def test_1024_queries_of_the_base_stage() -> None:
    fewer = N - 1024
    for name, per_query, published in (("tokengs", D, TOKENGS), ("locus", D + 3 + 1, LOCUSGS)):
        model = qgs.compose(RECIPES / name / "dl3dv.yaml", device="meta")
        count = sum(parameter.numel() for parameter in model.parameters())
        assert count == published - fewer * per_query


def test_counts_in_the_documents() -> None:
    text = (ROOT / "docs/experiments.md").read_text(encoding="utf-8")
    rows = re.findall(r"`(ablations/\w+\.yaml)`.* \| ([\d,]+) \|$", text, re.MULTILINE)
    assert len(rows) == 8
    shown = {recipe: int(count.replace(",", "")) for recipe, count in rows}
    assert shown == {recipe: parameters(recipe) for recipe in shown}
