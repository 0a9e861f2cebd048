"""Checks of a whole study before anything trains."""

import json
from collections.abc import Mapping
from itertools import product
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from qgs.contracts import OptionError
from qgs.evaluate.evaluation import Measures
from qgs.evaluate.plan import EvaluationIndex, EvaluationPlan, IndexEntry
from qgs.evaluate.protocol import index_of
from qgs.recipe import Recipe, resolve
from qgs.recipe.errors import Origin, Problems
from qgs.recipe.recipe import flat
from qgs.recipe.yaml_text import MapNode, dump
from qgs.train.folder import RunFolder
from qgs.wording import listed
from qgs_research.studies.runs import (
    BESIDE,
    Plan,
    differences,
    evaluation_file,
    read_evaluation,
    recipe_file,
)
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
            if path == INDEX and ours and theirs and index_of(recipe) == index_of(first):
                continue
            reported.add(option)
            reason = (
                f"`{path}` is {ours!r} in `{name}` and {theirs!r} in the reference "
                f"`{settings.reference}` ({recipe.provenance.get(path, 'absent')})"
            )
            fix = f"make them equal (`overlay` sets it for all), or add `differs: [{option}]`"
            problems.add(study.origins[name], f"variants.{name}", reason, fix)
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
        other = names.setdefault(json.dumps(tree, sort_keys=True), name)
        if other != name:
            reason = f"`{name}` is the same model as `{other}`"
            fix = "change an option of it, or leave one of them out"
            problems.add(study.origins[name], f"variants.{name}", reason, fix)


def check_data(plan: Plan) -> None:
    """Open every data source and index once. Raises as they do, OptionError for metrics."""
    settings = plan.study.settings
    metrics = [settings.metric, *(h.metric for h in settings.hypotheses if h.metric)]
    opened = set[str]()
    for variant, name in product(plan.recipes, plan.evaluations):
        recipe = plan.evaluation_recipe(variant, name)
        key = dump([recipe.tree[section] for section in ("data", "evaluation", "metrics")])
        if key in opened:
            continue
        opened.add(key)
        measures = Measures(recipe)
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
    """Raise ValueError where runs or results in the folder were made of something else.

    Where the evaluation index lies is no matter; which scenes and frames it names is.
    """
    for name, recipe in plan.recipes.items():
        file = recipe_file(plan.folder, name)
        folders = (plan.folder / "runs" / name).glob("seed-*")
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
        _refuse_changed_evaluation(plan, variant, name)


def _refuse_changed_evaluation(plan: Plan, variant: str, name: str) -> None:
    runs = [run for run in plan.runs if run.variant == variant and run.evaluated(name)]
    if not runs:
        return
    remedy = f"give the evaluation `{name}` another name" if name else "give another --out"
    file = evaluation_file(plan.folder, name)
    if name and file.is_file():
        before = _without_index(read_evaluation(file))
        if before != _without_index(plan.study.evaluations[name]):
            raise ValueError(
                f"{plan.study.file}: the results in {plan.folder} were judged by another `{name}` "
                f"({file}); {remedy}"
            )
    recipe = plan.evaluation_recipe(variant, name)
    index = index_of(recipe)
    for run in runs:
        if _stored_index(run.evaluation(name)) != index:
            raise ValueError(
                f"{plan.study.file}: the results in {run.evaluation(name)} were judged on other "
                f"scenes or frames than evaluation.index names now ({recipe.evaluation.index}); "
                f"{remedy}"
            )


def _stored_index(results: Path) -> EvaluationIndex | None:
    """The index by which results were made; raises ValueError for a file that is none."""
    content = json.loads((results / "protocol.json").read_text(encoding="utf-8"))
    index = content.get("views", {}).get("index")
    return index and TypeAdapter(dict[str, IndexEntry | None]).validate_python(index)


def _without_index(node: MapNode) -> dict[str, Any]:
    """The changes of an evaluation, whatever index it names."""
    return {path: value for path, value in flat(node).items() if path != INDEX}
