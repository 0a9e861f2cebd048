"""A study as it runs: every variant composed, checked against the others, and its folder."""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from qgs.cli.train import with_absolute_path
from qgs.composer import Recipe, RecipeError, resolve
from qgs.composer.errors import Origin, Problems
from qgs.composer.files import merge
from qgs.composer.recipe import annotated, flat
from qgs.composer.yaml_text import MapNode, dump, from_plain, load_mapping
from qgs.contracts import OptionError
from qgs.data.evaluation import EvaluationIndex, EvaluationPlan, IndexEntry
from qgs.engine.folder import RunFolder
from qgs.engine.guard import CollapseError, NonFiniteError
from qgs.engine.protocol import index_of
from qgs.io.files import write_text
from qgs.io.models import checkpoint_path
from qgs.wording import counted, listed
from qgs_studies.hypotheses import MAIN
from qgs_studies.study import Study

EQUAL = (
    *("data", "views", "training", "evaluation", "metrics"),
    *("losses", "objective", "init_from"),
)
"""Sections of recipes that are alike in all variants, but for what the study says differs.

All but the model and its optimiser.
"""

INDEX = "evaluation.index"
"""A file that may lie elsewhere today: it is compared by what it holds."""

_ENDS = (CollapseError.__name__, NonFiniteError.__name__)

_MOST = 12
"""Differences of a changed variant that the message names."""


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
        return self.failed.startswith(_ENDS)

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

    def done(self, run: Run) -> bool:
        """Whether nothing of `run` is missing."""
        return all(map(run.judged, self.evaluations))


def run_of(folder: Path, variant: str, seed: int) -> Run:
    """The run of a variant with a seed, of the study in `folder`."""
    return Run(variant, seed, folder / "runs" / variant / f"seed-{seed}")


def recipe_file(folder: Path, variant: str) -> Path:
    """The resolved recipe of a variant, of which its runs are trained."""
    return folder / "variants" / f"{variant}.yaml"


def evaluation_file(folder: Path, name: str) -> Path:
    """What an evaluation changes."""
    return folder / "evaluations" / f"{name}.yaml"


def planned(study: Study, folder: Path) -> Plan:
    """Compose all variants and check the study as a whole; nothing is written or trained.

    Raises as `composed`, what data sources raise, and ValueError where `folder` has runs of a
    variant, or results of an evaluation, that were another then.
    """
    recipes = composed(study)
    _check_data(study, recipes)
    plan = Plan(study, folder, recipes)
    _refuse_changed(plan)
    return plan


def composed(study: Study) -> dict[str, Recipe]:
    """The recipes of all variants, with the study's budget.

    Raises RecipeError with all that is wrong with them and with what differs between them, and
    what building them raises.
    """
    problems, recipes = Problems("study"), dict[str, Recipe]()
    for name, node in study.variants.items():
        try:
            recipes[name] = _with_budget(study, with_absolute_path(_resolved(study, node)))
        except RecipeError as error:
            for found in error.problems:
                at = Origin(found.file, found.line)
                option = f"variants.{name}: {found.option}"
                problems.add(at, option, found.reason, found.fix, found.cause)
    if len(recipes) == len(study.variants):
        _check_alike(study, recipes, problems)
        _check_distinct(study, recipes, problems)
        for name, recipe in recipes.items():
            for label, node in study.evaluations.items():
                _judged_by(recipe, node, f"evaluations.{label}, of {name}", problems)
    problems.raise_any()
    _build_all(study, recipes)
    return recipes


def judged_by(recipe: Recipe, node: MapNode) -> Recipe:
    """`recipe` as an evaluation changes it; raises RecipeError."""
    tree = from_plain(recipe.tree, Origin("the variant"))
    assert isinstance(tree, MapNode)
    return resolve(merge(tree, node))


def write_plan(plan: Plan) -> None:
    """The recipes and evaluations, from which workers train and judge; equal ones stay as they are.

    So a newer version that knows more options leaves the files readable for an older one at work.
    """
    for name, recipe in plan.recipes.items():
        file = recipe_file(plan.folder, name)
        if not file.is_file() or differences(resolve(file), recipe):
            write_text(file, annotated(recipe) + "\n")
    for name, node in plan.study.evaluations.items():
        file = evaluation_file(plan.folder, name)
        if not file.is_file() or read_evaluation(file) != node:
            write_text(file, dump(_plain(node)))


def read_evaluation(file: Path) -> MapNode:
    """What `write_plan` wrote of an evaluation; raises RecipeError."""
    problems = Problems("evaluation")
    node = load_mapping(file.read_text(encoding="utf-8"), str(file), problems)
    problems.raise_any()
    return node


def differences(ours: Recipe, theirs: Recipe) -> dict[str, tuple[Any, Any]]:
    """Options in which two recipes differ, seeds and names of plugins aside."""
    a, b = flat(ours.tree), flat(theirs.tree)
    paths = [p for p in {**a, **b} if p not in ("seed", "plugins") and a.get(p) != b.get(p)]
    return {path: (a.get(path), b.get(path)) for path in paths}


def _resolved(study: Study, node: MapNode) -> Recipe:
    return resolve(node, [f"seed={study.settings.seeds[0]}"])


def _with_budget(study: Study, recipe: Recipe) -> Recipe:
    budget, training = study.settings.budget, recipe.training
    if budget.seconds is not None:
        changes: dict[str, Any] = {"seconds": budget.seconds}
    elif budget.steps is not None:
        changes = {"steps": budget.steps, "seconds": None}
    else:
        assert budget.images is not None
        a_step = training.batch_size * training.accumulate * recipe.views.targets
        changes = {"steps": max(math.ceil(budget.images / a_step), 1), "seconds": None}
    tree = {**recipe.tree, "training": {**recipe.tree["training"], **changes}}
    resolved = resolve(tree)
    told = dict.fromkeys((f"training.{name}" for name in changes), "the study's budget")
    return replace(resolved, provenance={**recipe.provenance, **told})


def _check_alike(study: Study, recipes: Mapping[str, Recipe], problems: Problems) -> None:
    """Report what differs between variants although the study does not say so."""
    settings, first = study.settings, recipes[study.settings.reference]
    allowed, used = settings.differs, set[str]()
    free = {"training.steps"} if settings.budget.images is not None else set()
    for name, recipe in recipes.items():
        told = set[str]()
        for path, (ours, theirs) in differences(recipe, first).items():
            said = [a for a in allowed if f"{path}.".startswith(f"{a}.")]
            used.update(said)
            section, *names = path.split(".")
            if section not in EQUAL or said or path in free or _same_index(path, recipe, first):
                continue
            # of a loss or metric that is another, or absent, its options are one difference
            option = f"{section}.{names[0]}" if section in ("losses", "metrics") else path
            if option in told:
                continue
            told.add(option)
            reason = (
                f"`{path}` is {ours!r} in `{name}` and {theirs!r} in the reference "
                f"`{settings.reference}` ({recipe.provenance.get(path, 'absent')})"
            )
            fix = f"make them alike (`overlay` sets it for all), or add `differs: [{option}]`"
            problems.add(study.origins[name], f"variants.{name}", reason, fix)
    for path in (path for path in allowed if path not in used):
        reason, at = f"`{path}` differs in no variant", Origin(str(study.file))
        problems.add(at, "differs", reason, f"remove it; sections are {', '.join(EQUAL)}")


def _check_distinct(study: Study, recipes: Mapping[str, Recipe], problems: Problems) -> None:
    """Report variants that are one, such as a changed copy of a file that is read elsewhere."""
    for (a, one), (b, other) in combinations(recipes.items(), 2):
        if not differences(one, other):
            fix = "change an option of it, or leave one of them out"
            at = study.origins[b]
            problems.add(at, f"variants.{b}", f"`{b}` is the same model as `{a}`", fix)


def _same_index(path: str, one: Recipe, other: Recipe) -> bool:
    """Whether `path` is that of two indices that judge the same frames of the same scenes."""
    written = one.evaluation.index, other.evaluation.index
    return path == INDEX and all(written) and index_of(one) == index_of(other)


def _judged_by(recipe: Recipe, node: MapNode, option: str, problems: Problems) -> None:
    try:
        judged_by(recipe, node)
    except RecipeError as error:
        for found in error.problems:
            at = Origin(found.file, found.line) if found.line else node.origin
            problems.add(at, f"{option}: {found.option}", found.reason, found.fix, found.cause)


def _build_all(study: Study, recipes: Mapping[str, Recipe]) -> None:
    """Make every part of every variant, models without memory. Raises ValueError, with its name."""
    for name, recipe in recipes.items():
        try:
            recipe.build_optimizer()
            recipe.rate_factors(recipe.build_model("meta"))
            recipe.build_losses()
            recipe.build_objective()
            if recipe.init_from:
                checkpoint_path(recipe.init_from)
        except (ValueError, OSError) as error:
            error.add_note(f"in the variant `{name}`, {study.origins[name]}")
            raise


def _check_data(study: Study, recipes: Mapping[str, Recipe]) -> None:
    """Open every data source and index once. Raises as they do, OptionError for metrics."""
    opened = set[str]()
    for recipe in recipes.values():
        for judged in (recipe, *(judged_by(recipe, node) for node in study.evaluations.values())):
            key = dump([judged.tree["data"], judged.tree["evaluation"], judged.tree["metrics"]])
            if key in opened:
                continue
            opened.add(key)
            _refuse_unknown_metrics(study, judged)
            EvaluationPlan(judged.build_data(), judged.views, judged.evaluation, index_of(judged))


def _refuse_unknown_metrics(study: Study, recipe: Recipe) -> None:
    from qgs.engine.evaluation import Measures

    measures = Measures(recipe)
    columns, unavailable = measures.columns, measures.incomplete([])
    asked = [study.settings.metric, *(h.metric for h in study.settings.hypotheses)]
    for name in filter(None, asked):
        if name not in columns:
            raise OptionError(
                f"{study.file}: the recipes measure no `{name}`",
                f"choose one of {', '.join(columns)}, or add it to `overlay.metrics`",
            )
        if name in unavailable:
            raise OptionError(
                f"{study.file}: `{name}` cannot be measured here: {unavailable[name]}",
                f"mend that, or choose one of {', '.join({**columns}.keys() - unavailable)}",
            )


def _refuse_changed(plan: Plan) -> None:
    """Raise ValueError where runs or results in the folder were made of something else.

    Where the evaluation index lies is no matter; what results were judged by is.
    """
    for name, recipe in plan.recipes.items():
        file = recipe_file(plan.folder, name)
        runs = [run for run in _runs_in(plan.folder, name) if not RunFolder(run).is_new]
        if not runs or not file.is_file():
            continue
        changed = differences(resolve(file), recipe)
        changed.pop(INDEX, None)
        if changed:
            told = [f"{path}: {old!r} then, {new!r} now" for path, (old, new) in changed.items()]
            raise ValueError(
                f"{plan.study.file}: the variant `{name}` is not the one that {len(runs)} runs in "
                f"{plan.folder} were trained with ({listed(told, _MOST, '; ')}); give the new one "
                "another name, or another --out"
            )
    for name, node in plan.study.evaluations.items():
        file = evaluation_file(plan.folder, name)
        judged = any(run.judged(name) for run in plan.runs)
        if judged and file.is_file() and _moved(read_evaluation(file)) != _moved(node):
            raise ValueError(
                f"{plan.study.file}: the evaluation `{name}` is not the one that there are results "
                f"of in {plan.folder} ({file}); give the new one another name"
            )
    for name in plan.evaluations:
        for variant, recipe in plan.recipes.items():
            runs = [run for run in plan.runs if run.variant == variant and run.judged(name)]
            if runs:
                node = plan.study.evaluations.get(name)
                _refuse_other_index(plan, runs, name, judged_by(recipe, node) if node else recipe)


def _refuse_other_index(plan: Plan, runs: Sequence[Run], name: str, recipe: Recipe) -> None:
    now = index_of(recipe)
    for folder in (run.evaluation(name) for run in runs):
        if _judged_index(folder) != now:
            what = f"the evaluation `{name}` another name" if name else "another --out"
            raise ValueError(
                f"{plan.study.file}: the results in {folder} were judged on other scenes or "
                f"frames than evaluation.index names now ({recipe.evaluation.index}); give {what}"
            )


def _judged_index(results: Path) -> EvaluationIndex | None:
    """The index by which results were made; raises ValueError for a file that is none."""
    content = json.loads((results / "protocol.json").read_text(encoding="utf-8"))
    index = content.get("views", {}).get("index")
    return index and TypeAdapter(dict[str, IndexEntry | None]).validate_python(index)


def _moved(node: MapNode) -> dict[str, Any]:
    """An evaluation as plain values, whatever index it names."""
    plain = _plain(node)
    if "index" in plain.get("evaluation", {}):
        plain["evaluation"]["index"] = bool(plain["evaluation"]["index"])
    return plain


def _runs_in(folder: Path, variant: str) -> Iterator[Path]:
    yield from (p for p in (folder / "runs" / variant).glob("seed-*") if p.is_dir())


def _plain(node: Any) -> Any:
    if isinstance(node, Mapping):
        return {key: _plain(value) for key, value in node.items()}
    return [*map(_plain, node)] if isinstance(node, list) else node


def leftover_runs(plan: Plan) -> list[Path]:
    """Runs in the folder that the study no longer names; they are kept."""
    named = {run.folder for run in plan.runs}
    folders = (plan.folder / "runs").glob("*/seed-*")
    return sorted(path for path in folders if path.is_dir() and path not in named)
