"""Judging trained models, side by side, on the data of their recipe or on a user's photos."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from qgs.analysis.scenes import installed_sources
from qgs.cli import contest
from qgs.composer import Recipe, resolve
from qgs.contracts import SceneSource
from qgs.data.recognition import open_for
from qgs.engine.distributed import choose_device
from qgs.engine.evaluation import evaluate
from qgs.io.checkpoint import CheckpointFile
from qgs.io.models import about, checkpoint_path
from qgs.wording import short_names

WINDOWS = 6
"""Scenes, and windows of a scene, that are judged of a user's photos."""
HOLDOUT = 8
"""Every n-th of a user's photos is held out; of fewer photos the middle one."""
AUTO_SCALE = "Each scene is scaled until what its cameras look at is 1 away (views.scale: auto)."


def checkpoints(names: Sequence[str]) -> dict[str, Path]:
    """The files of the models `names` (see `checkpoint_path`), by short name."""
    return dict(zip(short_names(names), map(checkpoint_path, names), strict=True))


def judge(files: Mapping[str, Path], photos: str | None, device: str) -> list[contest.Entry]:
    """The models in `files`, of `checkpoints`, on unseen scenes, or on held-out photos.

    Raises as `load` and the data do, and ValueError where the recipes do not judge alike.
    """
    recipes, entries = recipes_alike(files, photos), []
    for name, recipe in recipes.items():
        with CheckpointFile(files[name]) as file:
            model = file.model(choose_device(device))
        evaluation = evaluate(model, recipe, trained_on=model.trained_on)
        parts = name, recipe, evaluation, model, about(files[name]), contest.curves_of(files[name])
        entries.append(contest.entry_of(*parts))
    return entries


def recipes_alike(files: Mapping[str, Path], photos: str | None) -> dict[str, Recipe]:
    """The recipes of `files`, of `checkpoints`; with the data at `photos` in place of their own.

    Raises as `CheckpointFile` and the data do, and ValueError where they do not judge alike.
    """
    recipes = dict[str, Recipe]()
    for name, path in files.items():
        with CheckpointFile(path) as file:
            recipes[name] = file.recipe
    if photos is not None:
        recipes = {name: _on_photos(recipe, photos) for name, recipe in recipes.items()}
    first, other = next(iter(recipes.items()))
    for name, recipe in recipes.items():
        contest.refuse_unequal(name, recipe, first, other, contest.JUDGED)
    return recipes


def remarks(entries: Sequence[contest.Entry]) -> list[str]:
    """What is to be said of results on photos, each sentence once."""
    told: dict[str, list[str]] = {}
    for entry in entries:
        for sentence in entry.evaluation.remarks:
            told.setdefault(sentence, []).append(entry.contender.name)
    sentences = [f"{', '.join(models)}: {sentence}." for sentence, models in told.items()]
    return [*sentences, AUTO_SCALE] if entries[0].recipe.views.scale == "auto" else sentences


def progress(files: Mapping[str, Path]) -> str:
    """How far the training of each model in `files` has come, of the steps of its recipe."""
    told = []
    for name, path in files.items():
        with CheckpointFile(path) as file:
            step, training = file.step, file.recipe.training
        of = "" if training.seconds else f" of {training.steps:,}"
        told.append(f"{name}: " + ("not known" if step is None else f"step {step:,}{of}"))
    return "; ".join(told)


def _on_photos(recipe: Recipe, photos: str) -> Recipe:
    """`recipe` with the data at `photos`, some of them held out, in place of its own.

    Data that it was not trained on has a unit of its own, so a constant `views.scale` becomes auto.
    """
    sources = installed_sources()
    source, own = open_for(photos, None, recipe.data_config, sources)
    views = {} if own or recipe.views.scale != "constant" else {"scale": "auto"}
    kind = next(name for name, component in sources.items() if component is type(source))
    options = source.config.model_dump(mode="json")
    if options.get("holdout") == 0:
        options["holdout"] = min(HOLDOUT, _fewest_photos(source))
    tree = {
        **recipe.tree,
        "data": {"type": kind, **options},
        "plugins": [*dict.fromkeys([*recipe.tree["plugins"], *{kind.split("/")[0]} - {"qgs"}])],
        "evaluation": {**recipe.tree["evaluation"], "scenes": WINDOWS, "index": None},
        "views": {**recipe.tree["views"], **views},
    }
    return resolve(tree)


def _fewest_photos(source: SceneSource) -> int:
    return min((len(scene) for scene in source.scenes("test")), default=HOLDOUT)
