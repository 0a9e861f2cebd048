"""A study as it runs: every variant composed, checked against the others, and its folder."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from qgs.checkpoint.models import checkpoint_path
from qgs.cli.train import with_absolute_path
from qgs.contracts import OptionError
from qgs.evaluate.evaluation import Measures
from qgs.evaluate.plan import EvaluationIndex, EvaluationPlan, IndexEntry
from qgs.evaluate.protocol import index_of
from qgs.files import write_text
from qgs.recipe import Recipe, RecipeError, resolve
from qgs.recipe.errors import Origin, Problems
from qgs.recipe.files import merge
from qgs.recipe.recipe import annotated, flat
from qgs.recipe.yaml_text import MapNode, dump, from_plain, load_mapping
from qgs.train.folder import RunFolder
from qgs.train.guard import CollapseError, NonFiniteError
from qgs.wording import counted, listed
from qgs_research.studies.hypotheses import MAIN
from qgs_research.studies.study import Study

EQUAL = (
    *("data", "views", "training", "evaluation", "metrics"),
    *("losses", "objective", "init_from"),
)
"""Sections of recipes that are equal in all variants unless `differs` names them.

All but the model and its optimiser.
"""

BESIDE = ("seed", "plugins")
"""What does not make a recipe another model."""

INDEX = "evaluation.index"
"""Compared by what the file holds, because it may have moved."""


@dataclass(frozen=True)
class Run:
    """One training of a variant. folder: where it is, as `qgs train` leaves it."""

    variant: str
    seed: int
    folder: Path

    def __str__(self) -> str:
        return f"{self.variant} seed {self.seed}"

    @property
    def log(self) -> Path:
        """What its processes print."""
        return self.folder.with_name(f"{self.folder.name}.log")

    @property
    def failure(self) -> Path:
        """Why it failed, where it did."""
        return self.folder.with_name(f"{self.folder.name}.failed")

    @property
    def failed(self) -> str:
        """Why it failed, the first sentence; "" where it did not."""
        text = self.failure.read_text(encoding="utf-8") if self.failure.is_file() else ""
        return text.strip().split("\n")[0].partition(". ")[0]

    @property
    def ended(self) -> bool:
        """Whether the training itself went wrong, as it would each time: it is not tried again."""
        return self.failed.startswith((CollapseError.__name__, NonFiniteError.__name__))

    def evaluation(self, name: str) -> Path:
        """The folder of its results by one evaluation."""
        return self.folder / (f"evaluation-{name}" if name else "evaluation")

    def judged(self, name: str) -> bool:
        """Whether that evaluation is there, as a whole: its last file is."""
        return (self.evaluation(name) / "protocol.json").is_file()


@dataclass(frozen=True)
class Plan:
    """What is to be trained and judged in `folder`. recipes: by variant, with the first seed."""

    study: Study
    folder: Path
    recipes: Mapping[str, Recipe]

    @property
    def evaluations(self) -> list[str]:
        """Names of all evaluations, the recipes' own first."""
        return [MAIN, *self.study.evaluations]

    @property
    def runs(self) -> list[Run]:
        """All runs, every variant with the first seed, then with the next."""
        seeds, names = self.study.settings.seeds, self.recipes
        return [run_of(self.folder, name, seed) for seed in seeds for name in names]

    @property
    def size(self) -> str:
        """Such as "4 variants x 3 seeds"."""
        variants = counted(len(self.recipes), "variant")
        return f"{variants} x {counted(len(self.study.settings.seeds), 'seed')}"

    @property
    def ended(self) -> list[Run]:
        """Runs that are not tried again, without results."""
        return [run for run in self.runs if run.ended and not self.done(run)]

    def judged_recipe(self, variant: str, evaluation: str) -> Recipe:
        """The recipe of a variant as an evaluation changes it."""
        recipe, node = self.recipes[variant], self.study.evaluations.get(evaluation)
        return judged_by(recipe, node) if node else recipe

    def done(self, run: Run) -> bool:
        """Whether nothing of `run` is missing."""
        return all(map(run.judged, self.evaluations))


def run_of(folder: Path, variant: str, seed: int) -> Run:
    """The run of a variant with a seed, of the study in `folder`."""
    return Run(variant, seed, folder / "runs" / variant / f"seed-{seed}")


def recipe_file(folder: Path, variant: str) -> Path:
    """The resolved recipe that the runs of a variant train."""
    return folder / "variants" / f"{variant}.yaml"


def evaluation_file(folder: Path, name: str) -> Path:
    """What an evaluation changes."""
    return folder / "evaluations" / f"{name}.yaml"


def planned(study: Study, folder: Path) -> Plan:
    """Compose all variants and check the study as a whole; nothing is written or trained.

    Raises as `composed`, what data sources raise, and ValueError where `folder` has runs of a
    variant, or results of an evaluation, that were another then.
    """
    plan = Plan(study, folder, composed(study))
    _check_data(plan)
    _refuse_changed(plan)
    return plan


def composed(study: Study) -> dict[str, Recipe]:
    """The recipes of all variants, with the study's budget.

    Raises RecipeError with all that is wrong with them and with what differs between them, and
    what building them raises.
    """
    problems, recipes = Problems("study"), dict[str, Recipe]()

    def report(error: RecipeError, place: str, where: Origin) -> None:
        for found in error.problems:
            at = Origin(found.file, found.line) if found.line else where
            problems.add(at, f"{place}: {found.option}", found.reason, found.fix, found.cause)

    for name, node in study.variants.items():
        try:
            recipe = resolve(node, [f"seed={study.settings.seeds[0]}"])
            recipes[name] = _with_budget(study, with_absolute_path(recipe))
        except RecipeError as error:
            report(error, f"variants.{name}", study.origins[name])
    if len(recipes) == len(study.variants):
        _check_equal(study, recipes, problems)
        models = dict[str, str]()
        for name, recipe in recipes.items():
            tree = {key: part for key, part in recipe.tree.items() if key not in BESIDE}
            other = models.setdefault(json.dumps(tree, sort_keys=True), name)
            if other != name:
                fix = "change an option of it, or leave one of them out"
                reason = f"`{name}` is the same model as `{other}`"
                problems.add(study.origins[name], f"variants.{name}", reason, fix)
        for label, node in study.evaluations.items():
            for name, recipe in recipes.items():
                try:
                    judged_by(recipe, node)
                except RecipeError as error:
                    report(error, f"evaluations.{label}, of {name}", node.origin)
    problems.raise_any()
    for name, recipe in recipes.items():
        try:
            _build(recipe)
        except (ValueError, OSError) as error:
            error.add_note(f"in the variant `{name}`, {study.origins[name]}")
            raise
    return recipes


def judged_by(recipe: Recipe, node: MapNode) -> Recipe:
    """`recipe` as an evaluation changes it; raises RecipeError."""
    tree = from_plain(recipe.tree, Origin("the variant"))
    assert isinstance(tree, MapNode)
    return resolve(merge(tree, node))


def write_plan(plan: Plan) -> None:
    """Write the recipes and evaluations from which workers train and judge, where they changed."""
    for name, recipe in plan.recipes.items():
        file = recipe_file(plan.folder, name)
        if not file.is_file() or differences(resolve(file), recipe):
            write_text(file, annotated(recipe) + "\n")
    for name, node in plan.study.evaluations.items():
        file = evaluation_file(plan.folder, name)
        if not file.is_file() or read_evaluation(file) != node:
            write_text(file, dump(json.loads(json.dumps(node))))


def read_evaluation(file: Path) -> MapNode:
    """What `write_plan` wrote of an evaluation; raises RecipeError."""
    problems = Problems("evaluation")
    node = load_mapping(file.read_text(encoding="utf-8"), str(file), problems)
    problems.raise_any()
    return node


def differences(ours: Recipe, theirs: Recipe) -> dict[str, tuple[Any, Any]]:
    """Options in which two recipes differ, seeds and names of plugins aside."""
    a, b = flat(ours.tree), flat(theirs.tree)
    paths = [p for p in {**a, **b} if p not in BESIDE and a.get(p) != b.get(p)]
    return {path: (a.get(path), b.get(path)) for path in paths}


def _with_budget(study: Study, recipe: Recipe) -> Recipe:
    budget, training = study.settings.budget, recipe.training
    if budget.seconds is not None:
        changes: dict[str, Any] = {"seconds": budget.seconds}
    elif budget.steps is not None:
        changes = {"steps": budget.steps, "seconds": None}
    else:
        assert budget.images is not None
        a_step = training.batch_size * recipe.views.targets
        changes = {"steps": max(math.ceil(budget.images / a_step), 1), "seconds": None}
    tree = {**recipe.tree, "training": {**recipe.tree["training"], **changes}}
    resolved = resolve(tree)
    origins = dict.fromkeys((f"training.{name}" for name in changes), "the study's budget")
    return replace(resolved, provenance={**recipe.provenance, **origins})


def _check_equal(study: Study, recipes: Mapping[str, Recipe], problems: Problems) -> None:
    """Report what differs between variants although the study does not name it."""
    settings, first = study.settings, recipes[study.settings.reference]
    free = {"training.steps"} if settings.budget.images is not None else set()
    used = set[str]()
    for name, recipe in recipes.items():
        reported = set[str]()
        for path, (ours, theirs) in differences(recipe, first).items():
            allowed = [a for a in settings.differs if f"{path}.".startswith(f"{a}.")]
            used.update(allowed)
            section, *names = path.split(".")
            # another loss or metric is one difference, whatever options it has
            option = f"{section}.{names[0]}" if section in ("losses", "metrics") else path
            if section not in EQUAL or allowed or path in free or option in reported:
                continue
            if path == INDEX and ours and theirs and index_of(recipe) == index_of(first):
                continue
            reported.add(option)
            reason = (
                f"`{path}` is {ours!r} in `{name}` and {theirs!r} in the reference "
                f"`{settings.reference}` ({recipe.provenance.get(path, 'absent')})"
            )
            fix = f"make them equal (`overlay` sets it for all), or add `differs: [{option}]`"
            problems.add(study.origins[name], f"variants.{name}", reason, fix)
    for path in (path for path in settings.differs if path not in used):
        reason, at = f"`{path}` differs in no variant", Origin(str(study.file))
        problems.add(at, "differs", reason, f"remove it; sections are {', '.join(EQUAL)}")


def _build(recipe: Recipe) -> None:
    """Make every part of a variant, the model without memory, to see that they fit."""
    recipe.build_optimizer()
    recipe.rate_factors(recipe.build_model("meta"))
    recipe.build_losses()
    recipe.build_objective()
    if recipe.init_from:
        checkpoint_path(recipe.init_from)


def _check_data(plan: Plan) -> None:
    """Open every data source and index once. Raises as they do, OptionError for metrics."""
    settings, opened = plan.study.settings, set[str]()
    for variant, name in product(plan.recipes, plan.evaluations):
        judged = plan.judged_recipe(variant, name)
        key = dump([judged.tree[section] for section in ("data", "evaluation", "metrics")])
        if key in opened:
            continue
        opened.add(key)
        measures = Measures(judged)
        unavailable = dict(measures.incomplete([]))
        for metric in (settings.metric, *(h.metric for h in settings.hypotheses if h.metric)):
            if metric not in measures.columns or metric in unavailable:
                raise OptionError(
                    f"{plan.study.file}: `{metric}` cannot be measured: "
                    f"{unavailable.get(metric, 'no recipe has it')}",
                    f"choose one of {', '.join({**measures.columns}.keys() - unavailable)}, or "
                    "add it to `overlay.metrics`",
                )
        EvaluationPlan(judged.build_data(), judged.views, judged.evaluation, index_of(judged))


def _refuse_changed(plan: Plan) -> None:
    """Raise ValueError where runs or results in the folder were made of something else.

    Where the evaluation index lies is no matter; what results were judged by is.
    """
    for name, recipe in plan.recipes.items():
        file, folders = recipe_file(plan.folder, name), (plan.folder / "runs" / name).glob("seed-*")
        runs = [run for run in folders if run.is_dir() and not RunFolder(run).is_new]
        if not runs or not file.is_file():
            continue
        changed = differences(resolve(file), recipe)
        changed.pop(INDEX, None)
        if changed:
            shown = [f"{path}: {old!r} then, {new!r} now" for path, (old, new) in changed.items()]
            raise ValueError(
                f"{plan.study.file}: the variant `{name}` is not the one that {len(runs)} runs in "
                f"{plan.folder} were trained with ({listed(shown, between='; ')}); give the new "
                "one another name, or another --out"
            )
    for variant, name in product(plan.recipes, plan.evaluations):
        runs = [run for run in plan.runs if run.variant == variant and run.judged(name)]
        if not runs:
            continue
        remedy = f"give the evaluation `{name}` another name" if name else "give another --out"
        file = evaluation_file(plan.folder, name)
        if name and file.is_file():
            before, now = read_evaluation(file), plan.study.evaluations[name]
            if _but_index(before) != _but_index(now):
                why = f"the results in {plan.folder} were judged by another `{name}` ({file})"
                raise ValueError(f"{plan.study.file}: {why}; {remedy}")
        recipe = plan.judged_recipe(variant, name)
        now = index_of(recipe)
        for folder in (run.evaluation(name) for run in runs):
            if _judged_index(folder) != now:
                raise ValueError(
                    f"{plan.study.file}: the results in {folder} were judged on other scenes or "
                    f"frames than evaluation.index names now ({recipe.evaluation.index}); {remedy}"
                )


def _judged_index(results: Path) -> EvaluationIndex | None:
    """The index by which results were made; raises ValueError for a file that is none."""
    content = json.loads((results / "protocol.json").read_text(encoding="utf-8"))
    index = content.get("views", {}).get("index")
    return index and TypeAdapter(dict[str, IndexEntry | None]).validate_python(index)


def _but_index(node: MapNode) -> dict[str, Any]:
    """What an evaluation changes, whatever index it names."""
    return {path: value for path, value in flat(node).items() if path != INDEX}
