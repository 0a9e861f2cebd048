"""Judging trained models, side by side, on the data of their recipe or on a user's photos."""

from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath

from qgs.cli import contest
from qgs.composer import Recipe, resolve
from qgs.composer.registry import load_sound_plugins
from qgs.contracts import SceneSource, SceneSourceConfig
from qgs.data.domain import Domain, verdict
from qgs.data.recognition import open_for
from qgs.data.sampling import Sample
from qgs.engine.distributed import choose_device
from qgs.engine.evaluation import evaluate
from qgs.engine.folder import checkpoint_of
from qgs.io.checkpoint import load, load_domain, load_recipe

WINDOWS = 6
"""Scenes, and windows of a scene, that are judged of a user's photos."""
HOLDOUT = 8
"""Every n-th of a user's photos is held out; of fewer photos the middle one."""


def checkpoints(names: Sequence[str]) -> dict[str, Path]:
    """The files of the models `names` (see `checkpoint_of`), by short name."""
    return {_label(name): checkpoint_of(name) for name in names}


def judge(files: Mapping[str, Path], photos: str | None, device: str) -> list[contest.Entry]:
    """The models in `files`, of `checkpoints`, on unseen scenes, or on held-out photos.

    Raises as `load` and the data do, and ValueError where the recipes do not judge alike.
    """
    recipes = {name: load_recipe(file) for name, file in files.items()}
    for file in files.values():
        load_domain(file)  # a damaged one is told before the work
    if photos is not None:
        recipes = {name: _on_photos(recipe, photos) for name, recipe in recipes.items()}
    (first, other), entries = next(iter(recipes.items())), []
    for name, recipe in recipes.items():
        contest.refuse_unequal(name, recipe, first, other, contest.JUDGED)
    for name, recipe in recipes.items():
        model = load(files[name], choose_device(device))
        entries.append(contest.entry_of(name, recipe, evaluate(model, recipe), model))
    return entries


def likeness(files: Mapping[str, Path], samples: Sequence[Sample]) -> list[str]:
    """How `samples` lie to what each model in `files` was trained on, a sentence once."""
    found = Domain()
    for sample in samples:
        found.see(sample.inputs.cameras, sample.targets.cameras)
    told: dict[str, list[str]] = {}
    for name, file in files.items():
        told.setdefault(verdict(load_domain(file), found), []).append(name)
    return [f"{', '.join(models)}: {sentence}" for sentence, models in told.items()]


def _label(name: str) -> str:
    """`locus-64` of rooms/locus-64 and of models/locus-64.safetensors; a run's own name."""
    return PurePosixPath(name).name.removesuffix(".safetensors")


def _on_photos(recipe: Recipe, photos: str) -> Recipe:
    """`recipe` with the data at `photos`, some of them held out, in place of its own."""
    registry, _ = load_sound_plugins()
    sources = registry.components("data")
    trained = recipe.parts["data",].config if ("data",) in recipe.parts else None
    known = trained if isinstance(trained, SceneSourceConfig) else None
    source, _ = open_for(photos, None, known, sources)
    kind = next(name for name, component in sources.items() if component is type(source))
    options = source.config.model_dump(mode="json")
    if options.get("holdout") == 0:
        options["holdout"] = min(HOLDOUT, _fewest_photos(source))
    tree = {
        **recipe.tree,
        "data": {"type": kind, **options},
        "plugins": [*dict.fromkeys([*recipe.tree["plugins"], *{kind.split("/")[0]} - {"qgs"}])],
        "evaluation": {**recipe.tree["evaluation"], "scenes": WINDOWS, "index": None},
    }
    return resolve(tree)


def _fewest_photos(source: SceneSource) -> int:
    return min((len(scene) for scene in source.scenes("test")), default=HOLDOUT)
