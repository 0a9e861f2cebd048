"""Checks of a whole study before anything trains."""

import json
from collections.abc import Mapping
from itertools import product
from pathlib import Path

from pydantic import TypeAdapter

from qgs.contracts import OptionError
from qgs.evaluate.evaluation import Measures
from qgs.evaluate.plan import EvaluationIndex, EvaluationPlan, IndexEntry
from qgs.evaluate.protocol import index_of
from qgs.recipe import Recipe, resolve
from qgs.recipe.errors import Origin, Problems
from qgs.recipe.yaml_text import dump
from qgs.train.folder import RunFolder
from qgs.wording import listed
from qgs_research.studies.runs import BESIDE, Plan, Run, differences, recipe_file
from qgs_research.studies.study import Study

EQUAL = (
    *("data", "views", "training", "evaluation", "metrics"),
    *("losses", "objective", "init_from"),
)
"""Sections of recipes that are equal in all variants unless `differs` names them.

All but the model and its optimiser.
"""

INDEX = "evaluation.index"
"""Compared by what the file holds, because it may have moved."""


def check_equal(study: Study, recipes: Mapping[str, Recipe], problems: Problems) -> None:
    """Report what differs between variants although the study does not name it."""
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
            # Another loss or metric is one difference, whatever options it has.
            option = f"{section}.{names[0]}" if section in ("losses", "metrics") else path
            if section not in EQUAL or allowed or option in reported:
                continue
            # As many images are as many steps only in equal batches.
            if path == "training.steps" and settings.budget.images is not None:
                continue
            # Variants of several files may name one index by different paths.
            if path == INDEX and index_of(recipe) == index_of(first):
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
            reason = f"`{path}` differs in no variant"
            problems.add(at, "differs", reason, f"remove it; sections are {', '.join(EQUAL)}")


def check_distinct(study: Study, recipes: Mapping[str, Recipe], problems: Problems) -> None:
    """Report variants that are one model."""
    names: dict[str, str] = {}
    for name, recipe in recipes.items():
        tree = {key: part for key, part in recipe.tree.items() if key not in BESIDE}
        # The whole recipe is the key: two names of one model would count as two tries.
        other = names.setdefault(json.dumps(tree, sort_keys=True), name)
        if other != name:
            reason = f"`{name}` is the same model as `{other}`"
            fix = "change an option of it, or leave one of them out"
            problems.add(study.variants[name].origin, f"variants.{name}", reason, fix)


def check_data(plan: Plan) -> None:
    """Open every data source and index once. Raises as they do, OptionError for metrics."""
    settings = plan.study.settings
    metrics = [settings.metric, *(h.metric for h in settings.hypotheses if h.metric)]
    opened = set[str]()
    for variant, name in product(plan.recipes, plan.evaluations):
        recipe = plan.evaluation_recipe(variant, name)
        # Most variants share their data: opening it takes seconds.
        key = dump([recipe.tree[section] for section in ("data", "evaluation", "metrics")])
        if key in opened:
            continue
        opened.add(key)
        measures = Measures(recipe)
        # LPIPS without its weights, for example: after the training would be too late.
        unavailable = dict(measures.incomplete([]))
        available = [metric for metric in measures.columns if metric not in unavailable]
        for metric in metrics:
            if metric not in available:
                raise OptionError(
                    f"{plan.study.file}: `{metric}` cannot be measured: "
                    f"{unavailable.get(metric, 'no recipe has it')}",
                    f"choose one of {', '.join(available)}, or add it to `overlay.metrics`",
                )
        EvaluationPlan(recipe.build_data(), recipe.views, recipe.evaluation, index_of(recipe))


def refuse_changed(plan: Plan) -> None:
    """Raise ValueError where runs or results in the folder were made of something else."""
    for variant, name in product(plan.recipes, plan.evaluations):
        recipe = plan.evaluation_recipe(variant, name)
        file = recipe_file(plan.folder, variant, name)
        # Runs of seeds that the study no longer names count too: it may name them again.
        folders = (plan.folder / "runs" / variant).glob("seed-*/")
        runs = [Run(variant, 0, folder) for folder in folders]
        evaluated = [run for run in runs if run.evaluated(name)]
        made = evaluated if name else [run for run in runs if not RunFolder(run.folder).is_new]
        changed = differences(resolve(file), recipe) if made and file.is_file() else {}
        # Where the index lies is no matter, but which scenes and frames it names.
        changed.pop(INDEX, None)
        index = index_of(recipe)
        if any(_stored_index(run.evaluation(name)) != index for run in evaluated):
            changed[INDEX] = ("other scenes or frames", recipe.evaluation.index)
        if changed:
            what = f"the evaluation `{name}`" if name else f"the variant `{variant}`"
            shown = [f"{path}: {old} then, {new} now" for path, (old, new) in changed.items()]
            raise ValueError(
                f"{plan.study.file}: {what} is not what {len(made)} runs in {plan.folder} were "
                f"made with ({listed(shown, between='; ')}); give {what} another name, or another "
                "--out"
            )


def _stored_index(results: Path) -> EvaluationIndex | None:
    """Return the index by which results were made; raises ValueError for a file that is none."""
    content = json.loads((results / "protocol.json").read_text(encoding="utf-8"))
    index = content.get("views", {}).get("index")
    return index and TypeAdapter(dict[str, IndexEntry | None]).validate_python(index)
