"""Models of other builds: queries of the photos, layers of their own, memories without rays."""

from dataclasses import replace
from typing import Any, ClassVar

import pytest
import torch
from qgs_plugintools import CHECKS, Case, checks_for, run_check
from torch import Tensor, nn

from qgs.components import GaussianHead, MultiViewViT
from qgs.components.encoder import keys_and_values
from qgs.composer import RecipeError, resolve
from qgs.composer.registry import PluginError
from qgs.contracts import (
    CONTRACT_VERSION,
    GAUSSIAN_FIELDS,
    MEMORY_FIELDS,
    Component,
    ComponentConfig,
    DecoderLayer,
    Fields,
    FieldSpec,
    LayerParts,
    Loss,
    ModelDims,
    Plugin,
    Queries,
    Refinement,
)
from qgs.losses import Opacity, Visibility
from qgs.types import (
    Cameras,
    GaussianAttributes,
    ImageMemory,
    LayerPrediction,
    Photos,
    QueryState,
    Rendering,
    Views,
    map_tensors,
)

FEATURES = {"memory.features": MEMORY_FIELDS["memory.features"]}


class TokenQueries(Queries):
    """A query for every image token."""

    name: ClassVar[str] = "tokens"
    count = None

    def __init__(self, config: ComponentConfig, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.norm = nn.LayerNorm(dims.width)

    @classmethod
    def fields_read(cls, config: ComponentConfig) -> Fields:
        return FEATURES

    def forward(self, memory: ImageMemory, views: Views) -> QueryState:
        return QueryState(self.norm(memory.features))


class RowQueries(TokenQueries):
    """A query for every row of patches."""

    name: ClassVar[str] = "rows"

    @classmethod
    def fields_read(cls, config: ComponentConfig) -> Fields:
        return {**FEATURES, "memory.grid": MEMORY_FIELDS["memory.grid"]}

    def forward(self, memory: ImageMemory, views: Views) -> QueryState:
        assert memory.grid is not None
        x_BVRCD = self.norm(memory.features).unflatten(1, memory.grid)
        return QueryState(x_BVRCD.mean(3).flatten(1, 2))


class BrightQueries(TokenQueries):
    """Queries of the tokens, of which dark ones are left out: their number varies by scene."""

    name: ClassVar[str] = "bright"

    def forward(self, memory: ImageMemory, views: Views) -> QueryState:
        light_BM = nn.functional.avg_pool2d(views.images.mean(2).flatten(0, 1), 8)
        return replace(
            super().forward(memory, views),
            mask=light_BM.reshape(len(memory.features), -1) > 0.5,
        )


class JointLayer(DecoderLayer):
    """Queries and image tokens attend to each other; both change."""

    name: ClassVar[str] = "joint"

    def __init__(self, config: Any, parts: LayerParts) -> None:
        super().__init__(config, parts)
        dims = parts.dims
        self.attention = nn.MultiheadAttention(dims.width, dims.heads, batch_first=True)

    @classmethod
    def fields_read(cls, config: ComponentConfig) -> Fields:
        return FEATURES

    def forward(self, state: QueryState, memory: ImageMemory) -> tuple[QueryState, ImageMemory]:
        tokens = memory.features.shape[1]
        x = torch.cat([memory.features, state.features], 1)
        x = x + self.attention(x, x, x, need_weights=False)[0]
        return state.replace(x[:, tokens:]), replace(memory, features=x[:, :tokens])


class BlindEncoder(MultiViewViT):
    """It has features alone, twice as wide as the model."""

    name: ClassVar[str] = "blind"

    @classmethod
    def fields_written(cls, config: ComponentConfig) -> Fields:
        return {"memory.features": FieldSpec((32,))}

    def forward(self, views: Views) -> ImageMemory:
        x_BMD = super().forward(views).features
        return ImageMemory(torch.cat([x_BMD, -x_BMD], -1))


class WideQueries(TokenQueries):
    """Queries of tokens that are 32 wide."""

    name: ClassVar[str] = "wide"

    @classmethod
    def fields_read(cls, config: ComponentConfig) -> Fields:
        return {"memory.features": FieldSpec((32,))}

    def forward(self, memory: ImageMemory, views: Views) -> QueryState:
        return QueryState(self.norm(memory.features[..., :16]))


class FeatureLoss(Loss):
    """The rendered features, which a head must give."""

    name: ClassVar[str] = "features"
    renderings = "each"

    @classmethod
    def fields_read(cls, config: ComponentConfig) -> Fields:
        return {"gaussians.features": GAUSSIAN_FIELDS["gaussians.features"]}

    def term(
        self, prediction: LayerPrediction, rendering: Rendering, target: Views, inputs: Views
    ) -> Tensor:
        assert rendering.features is not None
        return rendering.features.square().mean()


class FeatureHead(GaussianHead):
    """Gaussians that carry the first two features of their query."""

    name: ClassVar[str] = "carrying"

    @classmethod
    def fields_written(cls, config: ComponentConfig) -> Fields:
        return {"gaussians.features": GAUSSIAN_FIELDS["gaussians.features"]}

    def forward(self, state: QueryState) -> GaussianAttributes:
        x_BNK2 = state.features[:, :, None, :2].repeat(1, 1, self.gaussians_per_query, 1)
        return replace(super().forward(state), features=x_BNK2)


OF_PHOTOS = (TokenQueries, RowQueries, BrightQueries, JointLayer, BlindEncoder, WideQueries)
COMPONENTS = (*OF_PHOTOS, FeatureLoss, FeatureHead)
PLUGIN = Plugin("other", CONTRACT_VERSION, COMPONENTS)
NO_LAYERS = {"depth": 0}


def recipe(**model: Any) -> dict[str, Any]:
    sizes = {"width": 16, "heads": 2, "head": {"gaussians_per_query": 2}}
    small = {
        "encoder": {"patch_size": 8, "depth": 1},
        "decoder": {"depth": 2},
        "supervision": {"layers": [2]},
        "renderer": {"type": "qgs/torch"},
    }
    return {"recipe": 1, "plugins": ["other"], "model": {**sizes, **small, **model}}


def views(scenes: int = 2) -> Views:
    c2w = torch.eye(4).repeat(scenes, 2, 1, 1)
    lens = torch.tensor([16.0, 16.0, 8.0, 12.0]).expand(scenes, 2, 4)
    images = torch.rand(scenes, 2, 3, 24, 16, generator=torch.Generator().manual_seed(0))
    return Views(images, Cameras(c2w, lens, (24, 16)))


def made(**model: Any) -> Any:
    return resolve(recipe(**model), plugins=[PLUGIN]).build_model().eval()


def refused(**model: Any) -> list[str]:
    with pytest.raises(RecipeError) as caught:
        resolve(recipe(**model), plugins=[PLUGIN])
    return [f"{p.option}: {p.reason}; {p.fix}" for p in caught.value.problems]


def test_a_query_for_each_token_and_no_layer() -> None:
    model = made(queries={"type": "other/tokens"}, decoder=NO_LAYERS, supervision={"layers": [0]})
    prediction = model.train()(views())
    assert prediction.gaussians.count == 2 * 3 * 2 * 2  # views, rows, columns, K
    assert list(prediction.layers) == [0]
    prediction.gaussians.means.sum().backward()
    assert model.encoder.rgb_embedding.proj.weight.grad.any()
    one = views(1)
    assert (
        model(replace(one, images=1 - one.images))
        .gaussians.means.ne(prediction.gaussians.means[:1])
        .any()
    )
    with pytest.raises(
        ValueError, match=r"layers \[1\] do not exist; this model has layers 0\.\.0"
    ):
        model(one, layers=[1])


def test_a_resolved_recipe_without_layers_resolves_to_itself() -> None:
    first = resolve(recipe(decoder=NO_LAYERS, supervision={"layers": [0]}), plugins=[PLUGIN]).tree
    assert first["model"]["decoder"] == {"depth": 0, "layer_scale": 5e-5}
    assert resolve(first, plugins=[PLUGIN]).tree == first


def test_scenes_may_have_different_numbers_of_queries() -> None:
    model = made(queries={"type": "other/bright"}, decoder={"depth": 2, "layer_scale": 0.5})
    given = views()
    prediction = model(given)
    mask = prediction.state.mask
    assert len({int(scene.sum()) for scene in mask}) == 2
    per_query = prediction.gaussians.opacities.view(*mask.shape, -1)
    assert not per_query[~mask].any()
    assert (per_query[mask] > 0).all()

    def kept(scene: int, state: QueryState) -> Tensor:
        return model.predict(
            model.encoder(map_scene(given, scene)), state
        ).gaussians.means.unflatten(1, (-1, 2))

    for scene in range(2):
        start = model.queries(model.encoder(map_scene(given, scene)), map_scene(given, scene))
        alone = QueryState(start.features[:, mask[scene]])
        means = prediction.gaussians.means[scene : scene + 1].unflatten(1, (-1, 2))[:, mask[scene]]
        torch.testing.assert_close(kept(scene, alone), means, rtol=1e-4, atol=1e-5)


def map_scene(given: Views, scene: int) -> Views:
    cameras = given.cameras[scene : scene + 1]
    return Views(given.images[scene : scene + 1], cameras)


def test_a_layer_of_its_own_changes_the_memory_that_the_next_one_reads() -> None:
    model = made(decoder={"depth": 2, "layer": {"type": "other/joint"}})
    seen: list[Tensor] = []
    for layer in model.decoder:
        layer.register_forward_pre_hook(lambda _, args: seen.append(args[1].features))
    model(views())
    assert not torch.equal(*seen)
    assert "decoder.cross_attention" not in repr(model)
    assert {name.split(".")[2] for name, _ in model.decoder.named_parameters(prefix="decoder")} == {
        "attention"
    }


def test_what_fills_a_slot_that_the_layer_lacks_is_refused_and_null_drops_it() -> None:
    layer = {"depth": 2, "layer": {"type": "other/joint"}}
    (told,) = refused(decoder={**layer, "self_attention": {"type": "qgs/content"}})
    assert told.startswith("model.decoder.self_attention: `other/joint` ")
    assert "has no slot `self_attention`; remove it; `self_attention: null` drops one" in told
    assert made(decoder={**layer, "self_attention": None}).depth == 2
    swap = {"decoder.layers.0.feed_forward": {"type": "qgs/mlp"}}
    with pytest.raises(RecipeError, match="has no slot `feed_forward`"):
        resolve({**recipe(decoder=layer), "swap": swap}, plugins=[PLUGIN])


def test_one_layer_may_be_of_another_build() -> None:
    model = made(decoder={"depth": 2, "layers": {"1": {"layer": {"type": "other/joint"}}}})
    assert [type(layer).__name__ for layer in model.decoder] == ["CrossSelfMlp", "JointLayer"]
    assert model(views()).gaussians.count == 4096 * 2


@pytest.mark.parametrize("joint", ["0", "1"])
def test_a_decoder_of_two_builds_resolves_to_itself(joint: str) -> None:
    """Its template fills slots that one of the layers lacks, which is idle in that layer alone."""
    layers = {joint: {"layer": {"type": "other/joint"}}}
    chosen = {"type": "qgs/mlp", "ratio": 2.0}
    given = recipe(decoder={"depth": 2, "feed_forward": chosen, "layers": layers})
    first = resolve(given, plugins=[PLUGIN]).tree
    assert first["model"]["decoder"]["feed_forward"]["ratio"] == 2.0
    assert resolve(first, plugins=[PLUGIN]).tree == first
    layers[joint] = {**layers[joint], "feed_forward": chosen}
    (told,) = refused(decoder={"depth": 2, "layers": layers})
    assert told.startswith(f"model.decoder.layers.{joint}.feed_forward: `other/joint` ")


def test_a_decoder_without_layers_refuses_what_would_stand_in_them() -> None:
    told = refused(decoder={"depth": 0, "feed_forward": {"ratio": 2}}, supervision={"layers": [0]})
    reason = "a decoder of depth 0 has no layers, so nothing reads it"
    assert told == [
        f"model.decoder.feed_forward: {reason}; remove it; `feed_forward: null` drops one that is "
        "inherited"
    ]
    (told,) = refused(decoder=NO_LAYERS)
    assert "layers [2] do not exist in a decoder of depth 0; write [0]" in told
    (told,) = refused(supervision={"layers": [0]})
    assert "layers [0] do not exist in a decoder of depth 2; choose layers from 1 to 2" in told


def test_what_needs_keys_or_rays_is_refused_beside_an_encoder_without() -> None:
    blind = {"type": "other/blind", "patch_size": 8, "depth": 1}
    (told,) = refused(encoder=blind)
    assert "`qgs/content` needs memory.keys (D/h float32) and memory.values" in told
    told = " ".join(refused(encoder=blind, decoder={"depth": 2, "layer": {"type": "other/joint"}}))
    assert (
        "`other/joint` reads memory.features as D float32, `other/blind` at model.encoder" in told
    )
    assert "writes it as 32 float32" in told
    wide = made(
        encoder=blind,
        queries={"type": "other/wide"},
        decoder=NO_LAYERS,
        supervision={"layers": [0]},
    )
    assert wide(views()).gaussians.count == 24
    with pytest.raises(KeyError, match="the image memory has no keys; its encoder does not"):
        wide.encoder(views())["keys"]
    with pytest.raises(KeyError, match="the grid of an image memory is no tensor"):
        made().encoder(views())["grid"]
    with pytest.raises(KeyError, match="the image memory has no grid"):
        wide.encoder(views())["grid"]


def test_what_needs_the_grid_is_refused_beside_learned_latents() -> None:
    rows: Any = {
        "queries": {"type": "other/rows"},
        "decoder": NO_LAYERS,
        "supervision": {"layers": [0]},
    }
    assert made(**rows)(views()).gaussians.count == 2 * 3 * 2  # views, rows, K
    latents = {"type": "qgs/latent_bottleneck", "depth": 1, "blocks": [1], "latents": 5}
    (told,) = refused(**rows, encoder=latents)
    assert "`other/rows` needs memory.grid (3 int64), which nothing before it provides" in told
    assert "use `qgs/multiview_vit` in the slot `encoder`" in told


def test_a_layer_that_forgets_the_memory_is_reported() -> None:
    class Forgetful(JointLayer):
        name: ClassVar[str] = "forgetful"

        def forward(self, state: QueryState, memory: ImageMemory) -> Any:
            return super().forward(state, memory)[0]

    plugin = Plugin("mine", CONTRACT_VERSION, (Forgetful,))
    wanted = {
        **recipe(decoder={"depth": 1, "layer": {"type": "mine/forgetful"}}),
        "plugins": ["mine"],
    }
    wanted["model"]["supervision"] = {"layers": [1]}
    model = resolve(wanted, plugins=[plugin]).build_model()
    with pytest.raises(PluginError, match="returns QueryState, not a QueryState and an ImageM"):
        model(views())


class Careless(JointLayer):
    """It makes the memory anew, without what it does not read itself."""

    name: ClassVar[str] = "careless"

    def forward(self, state: QueryState, memory: ImageMemory) -> tuple[QueryState, ImageMemory]:
        state, memory = super().forward(state, memory)
        return state, ImageMemory(memory.features, values=memory.values)


class Unmasking(JointLayer):
    """It makes the state anew, without the mask."""

    name: ClassVar[str] = "unmasking"

    def forward(self, state: QueryState, memory: ImageMemory) -> tuple[QueryState, ImageMemory]:
        state, memory = super().forward(state, memory)
        return QueryState(state.features, state.fields), memory


class UnmaskingRefinement(Refinement):
    """It makes the state anew, without the mask."""

    name: ClassVar[str] = "unmasking"

    def forward(self, state: QueryState) -> QueryState:
        return QueryState(state.features, state.fields)


@pytest.mark.parametrize(
    ("decoder", "told"),
    [
        ({"layer": {"type": "mine/careless"}}, "careless` loses keys, patch_rays, grid of the ima"),
        ({"layer": {"type": "mine/unmasking"}}, "`mine/unmasking` loses the mask of the state"),
        ({"refinement": {"type": "mine/unmasking"}}, "`mine/unmasking` loses the mask of the sta"),
    ],
)
def test_a_component_that_loses_what_others_need_is_named(decoder: Any, told: str) -> None:
    plugin = Plugin("mine", CONTRACT_VERSION, (Careless, Unmasking, UnmaskingRefinement))
    wanted = recipe(queries={"type": "other/bright"}, decoder={"depth": 2, **decoder})
    model = resolve({**wanted, "plugins": ["other", "mine"]}, plugins=[PLUGIN, plugin])
    with pytest.raises(PluginError, match=told):
        model.build_model()(views())


@pytest.mark.parametrize("contract", [JointLayer, TokenQueries, UnmaskingRefinement])
@pytest.mark.parametrize("field", ["memory.features", "rendering.rgb", "gaussians.color"])
def test_what_no_state_holds_cannot_be_provided_by_a_state(contract: Any, field: str) -> None:
    def fields_written(cls: Any, config: ComponentConfig) -> Fields:
        return {field: FieldSpec((3,))}

    methods = {
        "name": "boasting",
        "fields_written": classmethod(fields_written),
        "__module__": __name__,
    }
    boasting = type("Boasting", (contract,), methods)
    place = {boasting.slot: {"type": "mine/boasting"}}
    wanted = recipe(**(place if contract is TokenQueries else {"decoder": {"depth": 2, **place}}))
    plugin = Plugin("mine", CONTRACT_VERSION, (boasting,))
    with pytest.raises(RecipeError, match=f"(?s)provides {field}, which .* has no way to write"):
        resolve({**wanted, "plugins": ["mine"]}, plugins=[plugin])


@pytest.mark.parametrize("component", [FeatureLoss, FeatureHead])
def test_features_of_gaussians_keep_the_contract(component: type[Component]) -> None:
    case = Case(component.Config())
    results = [run_check(check, case) for check in checks_for(case, ["core"])]
    assert not [result.message for result in results if not result.ok]


def test_a_loss_on_features_needs_a_head_that_gives_them() -> None:
    wanted = {**recipe(), "losses": {"mine": {"type": "other/features"}}}
    with pytest.raises(RecipeError, match=r"(?s)needs gaussians.features .*slot `head`"):
        resolve(wanted, plugins=[PLUGIN])
    wanted["model"]["head"]["type"] = "other/carrying"
    assert resolve(wanted, plugins=[PLUGIN])


class PictureEncoder(MultiViewViT):
    """An encoder that looks at pictures alone."""

    name: ClassVar[str] = "pictures"
    reads_cameras = False

    @classmethod
    def fields_written(cls, config: ComponentConfig) -> Fields:
        return {n: spec for n, spec in MEMORY_FIELDS.items() if n != "memory.patch_rays"}

    def forward(self, views: Views) -> ImageMemory:
        x_XPD = self.rgb_embedding(views.images.flatten(0, 1))
        x_BMD = self.norm(x_XPD.reshape(len(views.images), -1, self.dims.width))
        keys, values = keys_and_values(x_BMD, self.kv_proj, self.k_norm)
        return ImageMemory(x_BMD, keys, values)


def test_photos_need_cameras_only_where_they_are_read() -> None:
    plugin = Plugin("blind", CONTRACT_VERSION, (PictureEncoder,))
    wanted = {**recipe(encoder={"type": "blind/pictures", "patch_size": 8}), "plugins": ["blind"]}
    model = resolve(wanted, plugins=[plugin]).build_model().eval()
    given = views()
    torch.testing.assert_close(
        model(Photos(given.images)).gaussians.means, model(given).gaussians.means
    )
    with pytest.raises(ValueError, match="MultiViewViT of this model read cameras, and these"):
        made()(Photos(given.images))
    with pytest.raises(ValueError, match=r"Photos.images must have shape \(B, V, 3, H, W\)"):
        Photos(given.images[0])
    case = Case(PictureEncoder.Config(depth=0))
    check = CHECKS["unread_cameras_make_no_difference"]
    assert run_check(check, case).verdict == "passed"


@pytest.mark.parametrize(
    ("loss", "told"),
    [
        ({"type": "qgs/lpips"}, "LPIPS needs images of at least 16 pixels a side, the data's are"),
        ({"padding": "valid"}, "SSIM of whole windows needs images of at least 11 pixels a side"),
    ],
)
def test_losses_that_images_are_too_small_for_are_refused(loss: Any, told: str) -> None:
    data = {"type": "qgs/chunks", "path": "x", "image_size": [8, 16]}
    losses = {"mine": {"type": "qgs/photometric", **loss}}
    wanted = {**recipe(), "losses": losses, "data": data}
    with pytest.raises(RecipeError, match=told):
        resolve(wanted, plugins=[PLUGIN])
    assert resolve({**wanted, "data": {**data, "image_size": [16, 16]}}, plugins=[PLUGIN])
    idle = {"mine": {"type": "qgs/photometric", "padding": "valid", "ssim_weight": 0.0}}
    assert resolve({**wanted, "losses": idle}, plugins=[PLUGIN])


@pytest.mark.parametrize("loss", [Opacity(Opacity.Config()), Visibility(Visibility.Config())])
def test_losses_leave_out_gaussians_of_places_without_a_query(loss: Loss) -> None:
    """The mean over scenes of what each gives without these places."""
    model, given = made(queries={"type": "other/bright"}), views()
    prediction = model(given).layers[2]
    state, means = prediction.state, torch.randn(prediction.gaussians.means.shape)
    gaussians = replace(prediction.gaussians, means=means + torch.tensor([0.0, 0.0, 5.0]))
    nothing: Any = None
    (found,) = loss(LayerPrediction(gaussians, state), nothing, given, given).values()
    each = []
    for scene, mask in enumerate(state.mask):
        there = mask.repeat_interleave(2)
        kept = map_tensors(lambda x, i=scene, m=there: x[i : i + 1, m], gaussians)
        alone = LayerPrediction(kept, QueryState(state.features[scene : scene + 1, mask]))
        each += loss(alone, nothing, map_scene(given, scene), given).values()
    torch.testing.assert_close(found, torch.stack(each).mean())
    whole = LayerPrediction(gaussians, replace(state, mask=None))
    assert found != next(iter(loss(whole, nothing, given, given).values()))


def test_a_layer_scale_that_no_layer_reads_is_refused() -> None:
    class Plain(JointLayer):
        name: ClassVar[str] = "plain"
        reads_layer_scale = False

    plugin = Plugin("mine", CONTRACT_VERSION, (Plain,))

    def told(**decoder: Any) -> list[str]:
        wanted = recipe(decoder=decoder, supervision={"layers": [decoder["depth"]]})
        try:
            resolve({**wanted, "plugins": ["mine"]}, plugins=[plugin])
        except RecipeError as error:
            return [f"{p.option}: {p.reason}; {p.fix}" for p in error.problems]
        return []

    plain = {"layer": {"type": "mine/plain"}}
    (reason,) = told(depth=2, layer_scale=0.5, **plain)
    assert "layer_scale: `layer_scale` has no effect: `mine/plain` does not read it; remo" in reason
    assert "the default, `layer_scale: 5.0e-05`, drops an inherited one" in reason
    (reason,) = told(depth=0, layer_scale=0.5)
    assert "has no effect: a decoder of depth 0 does not read it" in reason
    assert not told(depth=2, layer_scale=5e-5, **plain)
    assert not told(depth=2, layer_scale=0.5, layers={"1": plain})


def test_input_views_are_judged_only_where_they_are_the_truth() -> None:
    judged = {**recipe(), "training": {"judge_inputs": True}}
    assert resolve(judged, plugins=[PLUGIN])
    moving = {"queries": {"type": "qgs/dynamic", "count": 8, "dynamic": 2}}
    cases = {
        "views.pose_noise moves the cameras of input views": {"views": {"pose_noise": 1.0}},
        "`qgs/dynamic` reconstructs one moment, input views": {
            "model": {**judged["model"], **moving},
            "objective": {"type": "qgs/dynamic"},
        },
    }
    for reason, changed in cases.items():
        with pytest.raises(RecipeError, match=reason) as caught:
            resolve({**judged, **changed}, plugins=[PLUGIN])
        (problem,) = caught.value.problems
        assert problem.option == "training.judge_inputs"
        assert resolve({**recipe(), **changed}, plugins=[PLUGIN])
