"""Open several trained models and evaluate all on the same scenes under one protocol."""

import math
import os
import re
from collections.abc import Collection, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any

import yaml

from qgs.checkpoint.model_file import CheckpointFile
from qgs.checkpoint.models import about, checkpoint_path
from qgs.contracts import Frames, Scene, SceneSource, ViewsConfig, Window
from qgs.data.inputs import Frusta, ranked_windows
from qgs.data.recognition import is_training_data, open_for
from qgs.data.view_samplers import Span
from qgs.domain import Domain
from qgs.evaluate.evaluation import evaluate
from qgs.evaluate.results import Evaluation
from qgs.model import QueryGaussianModel
from qgs.model_text import heading
from qgs.recipe import Recipe, resolve
from qgs.recipe.recipe import differing_options
from qgs.reconstruction.scale import (
    FoundScale,
    FoundSize,
    constant_scale,
    find_scale,
    find_size,
    photo_settings,
)
from qgs.reconstruction.scenes import (
    Size,
    holding_out,
    installed_sources,
    size_multiple,
    whole_size,
)
from qgs.train.distributed import choose_device
from qgs_viewer.trust import ScoredView, scored_views

# Scenes, and windows of a scene, that are judged of a user's photos.
WINDOWS = 6
ALONE = 2
"""Windows of a scene for a model that is compared with no other. Each takes a search for a scale,
the longest part of a report."""
# Sections of recipes that must be equal, so that only the models differ.
JUDGED = ("data", "views", "evaluation", "metrics")
TRAINED = ("optimizer", "training")
OF_THE_METHOD = (
    "optimizer.parts.",
    "training.judge_inputs.",
    "evaluation.tuning.",
    "evaluation.tuning_rate.",
    "views.scale.",
    "views.scale_factor.",
)
"""Options that may differ between compared recipes, because they belong to the method.

A dot ends each name, which leaves out longer names.

They set learning rates of parts of the model, a loss on input views, what tuning changes and how
fast, and the scale of the model's world. No score depends on the unit of that world.
"""


# Cost above the best window's up to which a window is shown.
POOR = 1.0


def spread_windows(
    scene: Scene, inputs: int, trained_on: Domain, count: int, middle: bool = False
) -> list[Window]:
    """Choose at most `count` windows: input photos, with the photos that renders are compared to.

    The first window is the best of `ranked_windows`. Each further window is nearly as good, and far
    from the windows chosen before it. inputs: number of input photos in a window. trained_on:
    ranges of distances and angles between the cameras in training, by which windows are ranked.
    middle: whether to add the photo in the middle between two inputs, if there is one. Raises
    ValueError if the scene has fewer photos than `inputs`.
    """
    frusta = Frusta(scene, trained_on)
    ranked = ranked_windows(frusta, inputs)
    good = {target: window for cost, window, target in ranked if cost <= ranked[0][0] + POOR}
    chosen = [*good][:1]
    while len(chosen) < min(count, len(good)):
        # the farthest from all chosen ones; of equal ones the best
        chosen.append(max(good.keys() - {*chosen}, key=lambda t: frusta.far[t, chosen].min()))
    windows = []
    for target in chosen:
        window = good[target]
        if middle:
            window = frusta.with_middle(window, (target, *scene.held_out))
        windows.append((window, frusta.compared(window, target)))
    return windows


class PhotoWindows(Span):
    """View sampler that chooses at most `count` windows of each scene by `spread_windows`.

    A window is a set of input photos with the photos that renders are compared to. The choice is
    made once for each scene. alone: whether renders of a scene whose photos are all inputs are
    compared with the inputs.
    """

    def __init__(self, trained_on: Domain, count: int, alone: bool) -> None:
        super().__init__(Span.Config())
        self._alone = alone
        self._trained_on = trained_on
        self._count = count
        self._known: dict[str, list[Window]] = {}

    def windows(self, scene: Scene, views: ViewsConfig) -> list[Window]:
        """Return pairs (input photos, photos to compare with) of a scene.

        The list is empty for a moving scene, whose photos have times. Raises ValueError if all
        photos are inputs, so that no photo is left to compare with, unless the scene is `alone`.
        """
        if scene.times is not None:
            # a moment of a moving scene has few views; the recipe's sampler knows which
            return []
        if scene.name not in self._known:
            windows = spread_windows(scene, views.inputs, self._trained_on, self._count, True)
            if not windows and not self._alone:
                raise ValueError(
                    f"all {len(scene)} photos are inputs, so no photo is left to compare renders "
                    "with: add a photo taken between them"
                )
            every = tuple(range(len(scene)))
            self._known[scene.name] = windows or [(every, every)]
        return self._known[scene.name]


@dataclass
class Model:
    """A trained model in a comparison.

    name: short and unique. file: checkpoint of the model. recipe: recipe of the training, but with
    the data of the comparison. step: number of training steps; None if unknown. windows: sampler of
    input and compared photos from a user's photos; None if the scenes come from the recipe's data.
    size: image size that was found with this model. views: views that `evaluation` has scored.
    scales: scale of camera positions found for each window, by (scene name, input frames, compared
    frames), so that no window is searched twice.
    """

    name: str
    file: Path
    network: QueryGaussianModel
    recipe: Recipe
    step: int | None
    windows: PhotoWindows | None = None
    size: FoundSize | None = None
    views: list[ScoredView] = field(default_factory=list)
    scales: dict[tuple[str, Frames, Frames], FoundScale] = field(default_factory=dict)

    def views_of(self, scene: Scene, inputs: Frames, compared: Frames) -> ViewsConfig:
        """Return the recipe's view settings, with the scale found for a window.

        A window is a scene with its input frames and the frames that renders are compared to. If
        the scale of the settings is not `search`, they are returned unchanged.
        """
        views = self.recipe.views
        if views.scale != "search":
            return views
        key = (scene.name, inputs, compared)
        if key not in self.scales:
            self.scales[key] = find_scale(self.network, scene, inputs, compared, views)
        return constant_scale(views, self.scales[key].factor)

    @cached_property
    def evaluation(self) -> Evaluation:
        """Scores on the test views of `recipe`. The evaluation leaves the network on the CPU."""
        found = evaluate(
            self.network,
            self.recipe,
            self.step,
            views_of=self.views_of,
            sampler=self.windows,
            show=lambda *shown: self.views.extend(scored_views(*shown)),
        )
        # the next model needs the memory of the accelerator
        self.network.cpu()
        return found

    @property
    def about(self) -> str:
        """First paragraph of the model's card; without a card, a line with the model's sizes."""
        return about(self.file) or heading(self.network)

    @property
    def parameters(self) -> int:
        """Number of parameters of the model."""
        return sum(parameter.numel() for parameter in self.network.parameters())

    @property
    def recipe_text(self) -> str:
        """Recipe of the training, with its data replaced by that of the comparison, as YAML."""
        return yaml.safe_dump(dict(self.recipe.tree), sort_keys=False, allow_unicode=True)


def numbered_names(paths: Sequence[str | os.PathLike[str]]) -> list[str]:
    """Return short names of models or recipes; repeated paths are numbered.

    Common folders and suffixes are left out: `a/x.yaml`, `b/x.yaml` and `b/x.yaml` give the names
    `a/x`, `b/x` and `b/x (2)`.
    """
    files = [os.path.abspath(path) for path in paths]
    shared = os.path.commonpath([os.path.dirname(file) for file in files])
    suffix = r"\.(ya?ml|safetensors)$"
    names = [re.sub(suffix, "", os.path.relpath(file, shared)) for file in files]
    return [
        f"{name} ({before + 1})" if (before := names[:index].count(name)) else name
        for index, name in enumerate(names)
    ]


def open_models(
    names: Sequence[str],
    photos: str | None,
    device: str,
    size: Size | None = None,
    overrides: Sequence[str] = (),
    gaussians: int | None = None,
) -> list[Model]:
    """Load models for a comparison on unseen scenes of their data, or on held-out `photos`.

    names: run folders, checkpoints, URLs or shipped models. photos, size, overrides: passed on to
    `recipes_alike`. device: as for `choose_device`. gaussians: as for `CheckpointFile`. Without
    `size`, the first model decides on the size of photos by `find_size`.
    Raises ValueError if models cannot be compared under one protocol.
    """
    device = choose_device(device)
    with ExitStack() as opened:
        paths = map(checkpoint_path, names)
        files = [opened.enter_context(CheckpointFile(path, gaussians)) for path in paths]
        trained = {n: file.recipe for n, file in zip(numbered_names(names), files, strict=True)}
        recipes = recipes_alike(trained, photos, size, overrides)
        models = [
            Model(name, file.path, file.model(device), recipe, file.step)
            for file, (name, recipe) in zip(files, recipes.items(), strict=True)
        ]
    if photos is None:
        return models
    first = models[0]
    # those of the first model for all, so that one protocol judges them
    count = ALONE if len(models) == 1 else WINDOWS
    data = recipes[first.name].build_data()
    alone = len({*data.names("train"), *data.names("test")}) == 1
    windows = PhotoWindows(first.network.trained_on, count, alone)
    fixed = any(
        is_training_data(photos, recipe.data_config) or size_multiple(recipe) is None
        for recipe in trained.values()
    )
    if size is None and not fixed:
        first.size = _found_size(first, windows, data)
    if first.size and first.size.halved:
        height, width = first.recipe.tree["data"]["image_size"]
        recipes = recipes_alike(trained, photos, (height // 2, width // 2), overrides)
    for model in models:
        model.windows = windows
        model.recipe = recipes[model.name]
    return models


def _found_size(model: Model, windows: PhotoWindows, data: SceneSource) -> FoundSize | None:
    """Return the better size of photos of `data` for `model`; None without a choice."""
    try:
        scene = data.scenes("test" if data.names("test") else "train")[0]
        window, *_ = windows.windows(scene, model.recipe.views)
    # the evaluation names scenes that fail; a moving scene has no windows
    except Exception:
        return None
    views = model.views_of(scene, *window)
    return find_size(model.network, scene, *window, views)


def resolve_fairly(files: Sequence[str | Path], seconds: float, seed: int) -> dict[str, Recipe]:
    """Return checked recipes by short name, all with one time budget (seconds) and one seed.

    Raises ValueError if two recipes differ in data, views, evaluation, metrics, optimizer or
    training, except in the options OF_THE_METHOD, such as `views.scale`.
    """
    # a number of steps that no time budget reaches
    overrides = [f"training.seconds={seconds}", "training.steps=1000000000", f"seed={seed}"]
    names = numbered_names(files)
    recipes = {name: resolve(f, overrides) for name, f in zip(names, files, strict=True)}
    refuse_unequal(recipes, (*JUDGED, *TRAINED))
    return recipes


def refuse_unequal(recipes: Mapping[str, Recipe], sections: Sequence[str]) -> None:
    """Raise ValueError if two recipes differ in one of `sections`.

    The options in OF_THE_METHOD, such as `views.scale`, may differ.
    """
    first = next(iter(recipes))
    for name, recipe in recipes.items():
        # one protocol for all, or their scores could not be set side by side
        paths = differing_options(recipe.tree, recipes[first].tree)
        places = {path.split(".")[0] for path in paths if not f"{path}.".startswith(OF_THE_METHOD)}
        unequal = [section for section in sections if section in places]
        if unequal:
            raise ValueError(
                f"{name} and {first} differ in {', '.join(unequal)}, so their scores cannot be "
                "compared; make these sections of the recipes equal, or report on one model alone"
            )


def recipes_alike(
    trained: Mapping[str, Recipe],
    photos: str | None,
    size: Size | None,
    overrides: Sequence[str] = (),
) -> dict[str, Recipe]:
    """Return the recipes of trained models, by name, with `photos` as their data if given.

    trained: recipe of the training, by name. photos: folder or video; None keeps the data of the
    recipes. size: (H, W) of the photos in pixels; by default a size that all models take and that
    crops no photo. overrides: settings of `views` for photos, such as a scale.

    Raises ValueError if recipes differ in how models are evaluated. Errors of the readers of photos
    pass through.
    """
    recipes = dict(trained)
    if photos is not None:
        data = _data_of(photos, recipes.values(), size)
        plugin = data["type"].split("/")[0]
        first = next(iter(recipes.values())).tree["views"]
        for name, recipe in recipes.items():
            own = is_training_data(photos, recipe.data_config)
            views = {
                **recipe.tree["views"],
                "gap": first["gap"],
                "targets": first["targets"],
                # photos that it was not trained on have a unit of their own
                "scale": photo_settings(recipe.views, own).scale,
            }
            tree = {
                **recipe.tree,
                "data": data,
                # photos may need a plug-in that the recipe does not name
                "plugins": [*dict.fromkeys([*recipe.tree["plugins"], *{plugin} - {"qgs"}])],
                # an index of the recipe's data names none of these photos
                "evaluation": {**recipe.tree["evaluation"], "scenes": WINDOWS, "index": None},
                "views": views,
            }
            recipes[name] = resolve(tree, overrides)
    refuse_unequal(recipes, JUDGED)
    return recipes


def _data_of(photos: str, recipes: Collection[Recipe], size: Size | None) -> dict[str, Any]:
    """Return a recipe section `data` that reads `photos` in a size that all `recipes` take.

    Some photos are held out to compare renders with. If a recipe was trained on `photos`, the
    photos that its training held out are used.
    """
    sources = installed_sources()
    trained = [recipe.data_config for recipe in recipes]
    # as a model that was trained on them opens them: its held-out photos are no training data
    config = next((data for data in trained if is_training_data(photos, data)), trained[0])
    source, own = open_for(photos, size, config, sources)
    scene = next(chain(source.scenes("test"), source.scenes("train")), None)
    config = source.config
    if not own and scene is not None:
        # cropped photos would hide part of the user's scene
        multiples = [*map(size_multiple, recipes)]
        # a multiple of all models' sizes; none where one takes a single size
        common = math.lcm(*filter(None, multiples)) if all(multiples) else None
        size = size or whole_size(scene, common)
        config = holding_out(config, scene)
    # recipes know sources of data by PLUGIN/NAME
    kind = next(name for name, component in sources.items() if component is type(source))
    options = config.model_dump(mode="json")
    return {"type": kind, **options, "image_size": [*(size or config.image_size)]}
