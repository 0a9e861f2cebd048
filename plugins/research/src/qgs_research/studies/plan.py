"""The plan of a study: its runs and their files, and checks of all recipes before training."""

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from pydantic_core import to_jsonable_python

from qgs.checkpoint.models import checkpoint_path
from qgs.cli.train import with_absolute_path
from qgs.contracts import OptionError
from qgs.evaluate.evaluation import Measures
from qgs.evaluate.plan import EvaluationPlan, read_index
from qgs.files import write_text
from qgs.recipe import Recipe, RecipeError, resolve
from qgs.recipe.errors import Origin, Problems
from qgs.recipe.files import merge, read_recipe
from qgs.recipe.recipe import annotated, differing_options
from qgs.recipe.yaml_text import dump, from_plain
from qgs.train.folder import RunFolder
from qgs.wording import listed
from qgs_research.studies.study import MAIN, Study

BESIDE = ("seed", "plugins")
"""Keys of a recipe that are ignored when the recipes of variants are compared."""


@dataclass(frozen=True)
class Run:
    """Training of one variant with one seed.

    folder: run folder, with the same files as the run folder of `qgs train`.
    """

    variant: str
    seed: int
    folder: Path

    def __str__(self) -> str:
        return f"{self.variant} seed {self.seed}"

    def beside(self, suffix: str) -> Path:
        """Return the path of a file next to the run folder: `beside("lock")` is `seed-0.lock`."""
        return self.folder.with_name(f"{self.folder.name}.{suffix}")

    @property
    def log(self) -> Path:
        """Path of the file with the printed output of the run."""
        return self.beside("log")

    @property
    def failure(self) -> Path:
        """Path of the file with the error of a failed run."""
        return self.beside("failed")

    @property
    def failed(self) -> str:
        """First sentence of the error of a failed run; "" if the run has not failed."""
        if not self.failure.is_file():
            return ""
        # The rest of the file is advice, which has no room in tables.
        first_line = self.failure.read_text(encoding="utf-8").strip().split("\n")[0]
        return first_line.partition(". ")[0]

    def evaluation(self, name: str) -> Path:
        """Return the folder for the results of this run in the evaluation `name`."""
        return self.folder / (f"evaluation-{name}" if name else "evaluation")

    def evaluated(self, name: str) -> bool:
        """Return True if the results of this run in the evaluation `name` are complete."""
        # An evaluation writes this file last.
        return (self.evaluation(name) / "protocol.json").is_file()


@dataclass(frozen=True)
class Plan:
    """Runs and evaluations of a study in `folder`.

    recipes: checked recipe of each variant, changed as each evaluation says, by names of variant
    and evaluation. All have the study's first seed.
    """

    study: Study
    folder: Path
    recipes: Mapping[tuple[str, str], Recipe]

    @property
    def evaluations(self) -> list[str]:
        """Names of all evaluations. The first is "", the default evaluation."""
        return [MAIN, *self.study.evaluations]

    @property
    def runs(self) -> list[Run]:
        """All runs of the study: each variant with the first seed, then with the second, ..."""
        seeds = self.study.settings.seeds
        # Seeds come first, so that an unfinished study has complete comparisons.
        return [run_of(self.folder, name, seed) for seed in seeds for name in self.study.variants]

    def done(self, run: Run) -> bool:
        """Return True if all evaluations of `run` are complete."""
        return all(map(run.evaluated, self.evaluations))


def run_of(folder: Path, variant: str, seed: int) -> Run:
    """Return the run of `variant` with `seed` in the study folder `folder`."""
    return Run(variant, seed, folder / "runs" / variant / f"seed-{seed}")


def recipe_file(folder: Path, variant: str, evaluation: str = MAIN) -> Path:
    """Return the path of a variant's checked recipe in the study folder.

    By default it is the recipe for training; with `evaluation`, the recipe for this evaluation.
    """
    # Names have no @, which separates variant and evaluation in hypotheses too.
    name = f"{variant}@{evaluation}" if evaluation else variant
    return folder / "variants" / f"{name}.yaml"


def write_plan(plan: Plan) -> None:
    """Write the checked recipes of all variants, which the training processes read."""
    for place, recipe in plan.recipes.items():
        # Include the file and line that set each value, for readers of the folder.
        write_text(recipe_file(plan.folder, *place), f"{annotated(recipe)}\n")


def differences(ours: Recipe, theirs: Recipe) -> dict[str, tuple[str | None, str | None]]:
    """Return the options in which two recipes differ: pairs of values, by path of the option.

    A missing value is None. The options `seed` and `plugins` are left out.
    """
    found = differing_options(ours.tree, theirs.tree)
    return {path: values for path, values in found.items() if path not in BESIDE}


def planned(study: Study, folder: Path) -> Plan:
    """Check the recipes of all variants and return the plan of the study.

    Nothing is written or trained. Raises the errors of `composed` and of data sources. Raises
    ValueError if `folder` has results of a variant or an evaluation whose recipe has changed since
    they were made.
    """
    plan = Plan(study, folder, composed(study))
    check_data(plan)
    refuse_changed(plan)
    return plan


def composed(study: Study) -> dict[tuple[str, str], Recipe]:
    """Return the checked recipes of all variants, with the budget of the study.

    The keys are names of variant and evaluation; recipes of the default evaluation come first.
    Raises RecipeError with all faults of the recipes and all forbidden differences between them.
    Raises the errors of building the models.
    """
    problems = Problems("study")
    recipes: dict[str, Recipe] = {}
    # A budget of steps removes the recipe's limit on seconds.
    limits = {"seconds": None, **study.settings.budget.model_dump(exclude_none=True)}
    # With an origin, because `qgs compose` shows who set the budget.
    budget = from_plain({"training": limits}, Origin("the study's budget"))
    for name, node in study.variants.items():
        with _collected(problems, f"variants.{name}", node.origin):
            # A recipe has one seed, which each run replaces by its own.
            tree = merge(read_recipe(node, Problems()), budget)
            recipe = resolve(tree, [f"seed={study.settings.seeds[0]}"])
            recipes[name] = with_absolute_path(recipe)
    found = {(name, MAIN): recipe for name, recipe in recipes.items()}
    # Differences to a variant that cannot be composed are unknown.
    if len(recipes) == len(study.variants):
        check_equal(study, recipes, problems)
        check_distinct(study, recipes, problems)
        for label, node in study.evaluations.items():
            for name, recipe in recipes.items():
                with _collected(problems, f"evaluations.{label}, of {name}", node.origin):
                    tree = from_plain(recipe.tree, Origin("the variant"))
                    found[name, label] = resolve(merge(tree, node))
    problems.raise_any()
    for name, recipe in recipes.items():
        try:
            recipe.build_optimizer()
            # On the meta device, because published models would not fit into a laptop's memory.
            recipe.rate_factors(recipe.build_model("meta"))
            recipe.build_losses()
            recipe.build_objective()
            if recipe.init_from:
                checkpoint_path(recipe.init_from)
        except (ValueError, OSError) as error:
            # The error of a component does not name the variant.
            error.add_note(f"in the variant `{name}`, {study.variants[name].origin}")
            raise
    return found


@contextmanager
def _collected(problems: Problems, place: str, origin: Origin) -> Iterator[None]:
    """Add the faults of a RecipeError raised inside the block to `problems`; do not raise it.

    place: name of the checked part in the study file. origin: file and line of this part, used for
    faults without a line of their own.
    """
    try:
        yield
    except RecipeError as error:
        for found in error.problems:
            at = Origin(found.file, found.line) if found.line else origin
            problems.add(at, f"{place}: {found.option}", found.reason, found.fix, found.cause)


EQUAL = ("data", "views", "training", "evaluation", "metrics", "losses", "objective", "init_from")
"""Sections of recipes that must be equal in all variants, except for options in `differs`.

Model and optimiser may always differ.
"""

INDEX = "evaluation.index"
"""Option whose file content is compared instead of its path, because files may be moved."""


def check_equal(study: Study, recipes: Mapping[str, Recipe], problems: Problems) -> None:
    """Add a problem for each option in which a variant differs from the reference.

    Options in the study's `differs`, and the sections model and optimizer, may differ. Also adds a
    problem for each option in `differs` whose value is the same in all variants.
    """
    settings = study.settings
    first = recipes[settings.reference]
    used = set[str]()
    for name, recipe in recipes.items():
        reported = set[str]()
        for path, (ours, theirs) in differences(recipe, first).items():
            # `losses` allows `losses.photometric.weight`, but `loss` does not.
            allowed = [a for a in settings.differs if f"{path}.".startswith(f"{a}.")]
            used.update(allowed)
            section, *names = path.split(".")
            # Another loss or metric counts as one difference, whatever its options.
            option = f"{section}.{names[0]}" if section in ("losses", "metrics") else path
            if section not in EQUAL or allowed or option in reported:
                continue
            # Variants of several files may name one index by different paths.
            index = read_index(recipe.evaluation.index)
            if path == INDEX and index == read_index(first.evaluation.index):
                continue
            reported.add(option)
            reason = (
                f"`{path}` is {ours} in `{name}` and {theirs} in the reference "
                f"`{settings.reference}` ({recipe.provenance.get(path, 'absent')})"
            )
            fix = f"make them equal (`overlay` sets it for all), or add `differs: [{option}]`"
            problems.add(study.variants[name].origin, f"variants.{name}", reason, fix)
    for path in settings.differs:
        if path not in used:
            at = Origin(str(study.file))
            reason = f"`{path}` is the same in all variants"
            problems.add(at, "differs", reason, f"remove it; sections are {', '.join(EQUAL)}")


def check_distinct(study: Study, recipes: Mapping[str, Recipe], problems: Problems) -> None:
    """Add a problem for each variant whose recipe equals that of an earlier variant."""
    names: dict[str, str] = {}
    for name, recipe in recipes.items():
        tree = {key: part for key, part in recipe.tree.items() if key not in BESIDE}
        # The key is the whole recipe: two names of one model would count as two tries.
        other = names.setdefault(json.dumps(tree, sort_keys=True), name)
        if other != name:
            reason = f"`{name}` is the same model as `{other}`"
            fix = "change an option, or remove one of the two"
            problems.add(study.variants[name].origin, f"variants.{name}", reason, fix)


def check_data(plan: Plan) -> None:
    """Open the data source and the evaluation index of every variant and evaluation.

    Raises the errors of opening, and OptionError for a metric that cannot be measured.
    """
    settings = plan.study.settings
    metrics = [settings.metric, *(h.metric for h in settings.hypotheses if h.metric)]
    # Most variants share their data, and opening it takes seconds.
    distinct = {
        dump([recipe.tree[section] for section in ("data", "evaluation", "metrics")]): recipe
        for recipe in plan.recipes.values()
    }
    for recipe in distinct.values():
        measures = Measures(recipe)
        # For example, the weights of LPIPS may be missing; after training it would be too late.
        unavailable = dict(measures.incomplete([]))
        available = [metric for metric in measures.columns if metric not in unavailable]
        for metric in metrics:
            if metric not in available:
                raise OptionError(
                    f"{plan.study.file}: `{metric}` cannot be measured: "
                    f"{unavailable.get(metric, 'no recipe has it')}",
                    f"choose one of {', '.join(available)}, or add it to `overlay.metrics`",
                )
        sampler = recipe.build_view_sampler()
        EvaluationPlan(recipe.build_data(), recipe.views, recipe.evaluation, sampler)


def refuse_changed(plan: Plan) -> None:
    """Raise ValueError if a recipe has changed since it made results in the study folder."""
    for (variant, name), recipe in plan.recipes.items():
        file = recipe_file(plan.folder, variant, name)
        # Runs of seeds that the study no longer names count too, since it may name them again.
        folders = (plan.folder / "runs" / variant).glob("seed-*/")
        runs = [Run(variant, 0, folder) for folder in folders]
        evaluated = [run for run in runs if run.evaluated(name)]
        made = evaluated if name else [run for run in runs if not RunFolder(run.folder).is_new]
        changed = differences(resolve(file), recipe) if made and file.is_file() else {}
        # The place of the index does not matter, but its scenes and frames do.
        changed.pop(INDEX, None)
        index = read_index(recipe.evaluation.index)
        protocols = [run.evaluation(name) / "protocol.json" for run in evaluated]
        stored = [json.loads(file.read_bytes())["views"] for file in protocols]
        if any(views.get("index") != to_jsonable_python(index) for views in stored):
            changed[INDEX] = ("other scenes or frames", recipe.evaluation.index)
        if changed:
            what = f"the evaluation `{name}`" if name else f"the variant `{variant}`"
            shown = [f"{path}: {old} then, {new} now" for path, (old, new) in changed.items()]
            raise ValueError(
                f"{plan.study.file}: {what} has changed since {len(made)} runs in {plan.folder} "
                f"were made ({listed(shown, between='; ')}); undo the change, give {what} another "
                "name, or choose another --out"
            )
