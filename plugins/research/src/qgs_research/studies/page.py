"""study.html: the answer, the verdicts, the tables, the figures, what differs."""

import json
from pathlib import Path
from typing import Any

from qgs.drawing import page_environment
from qgs.drawing.figures import figure_picture
from qgs.drawing.images import data_uri
from qgs.files import write_text
from qgs.model_text import parameter_counts
from qgs.recipe import Recipe
from qgs_research.studies.figures import curves_figure, values_figure, write_figures
from qgs_research.studies.output import hypothesis_rows, table_rows, write_files
from qgs_research.studies.plan import differences
from qgs_research.studies.results import Results

_DPI = 150


def write_all(results: Results) -> Path:
    """All files, the figures and the page; the page."""
    write_files(results)
    write_figures(results)
    page = results.plan.folder / "study.html"
    write_text(page, study_html(results))
    return page


def study_html(results: Results) -> str:
    """The whole page; it needs no other file and no network."""
    plan, settings = results.plan, results.plan.study.settings
    environment = page_environment("qgs_research.studies", uri=data_uri)
    sections = []
    for name in plan.evaluations if results.columns else []:
        figure = values_figure(results, name)
        if figure is not None:
            rows = table_rows(results, name)
            picture = figure_picture(figure, dpi=_DPI)
            sections.append({"name": name, "rows": rows, "picture": picture})
    curves, budget = curves_figure(results), settings.budget.model_dump(exclude_none=True)
    done = len(plan.runs) - len(results.missing)
    facts = {
        "runs": f"{done} of {len(plan.runs)}: {plan.size}",
        "seeds": ", ".join(map(str, settings.seeds)),
        "budget": ", ".join(f"{n:,} {unit}" for unit, n in budget.items()),
        "reference": settings.reference,
        "may differ": ", ".join(["the model", "its optimiser", *settings.differs]),
    }
    return environment.get_template("study.html").render(
        title=plan.study.title,
        question=settings.question,
        answer=results.answer(),
        verdicts=hypothesis_rows(results) if results.columns and settings.hypotheses else [],
        sections=sections,
        curves=None if curves is None else figure_picture(curves, dpi=_DPI),
        notes=results.notes(),
        facts=facts,
        changes=_changes(results),
        sizes={name: _size(recipe) for name, recipe in plan.recipes.items()},
    )


def _size(recipe: Recipe) -> str:
    """What a model has to work with; Gaussians where queries make them, not pixels."""
    model = recipe.build_model("meta")
    found = f"{sum(parameter_counts(model).values()) / 1e6:.2f} M parameters"
    if not model.queries.count:
        return found
    return f"{found}, {model.queries.count * model.head.gaussians_per_query:,} Gaussians"


def _changes(results: Results) -> dict[str, list[tuple[str, str, str]]]:
    """Of every variant the options that differ from the reference's: path, its, the other's."""
    recipes, reference = results.plan.recipes, results.plan.study.settings.reference

    def shown(value: Any) -> str:
        return "–" if value is None else json.dumps(value)

    return {
        name: [
            (path, shown(ours), shown(theirs))
            for path, (ours, theirs) in differences(recipe, recipes[reference]).items()
        ]
        for name, recipe in recipes.items()
        if name != reference
    }
