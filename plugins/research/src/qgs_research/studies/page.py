"""study.html: the answer, the verdicts, the tables, the figures, what differs."""

from pathlib import Path

from qgs.drawing import page_environment
from qgs.drawing.figures import figure_picture
from qgs.drawing.images import data_uri
from qgs.files import write_text
from qgs.model_text import parameter_counts
from qgs.recipe import Recipe
from qgs.recipe.recipe import differing_options
from qgs_research.studies.figures import curves_figure, values_figure, write_figures
from qgs_research.studies.output import hypothesis_rows, table_rows, write_files
from qgs_research.studies.results import Results
from qgs_research.studies.runs import BESIDE
from qgs_research.studies.statements import answer, notes

_DPI = 150


def write_all(results: Results) -> Path:
    """Write all files, the figures and the page; return the page."""
    write_files(results)
    write_figures(results)
    page = results.plan.folder / "study.html"
    write_text(page, study_html(results))
    return page


def study_html(results: Results) -> str:
    """Return the whole page; it needs no other file and no network."""
    sections = []
    # A section for each evaluation that has results.
    for name in results.plan.evaluations:
        if figure := values_figure(results, name):
            picture = figure_picture(figure, dpi=_DPI)
            rows = table_rows(results, name)
            sections.append({"name": name, "rows": rows, "picture": picture})
    curves = curves_figure(results)
    template = page_environment("qgs_research.studies", uri=data_uri).get_template("study.html")
    return template.render(
        plan=results.plan,
        settings=results.settings,
        missing=len(results.missing),
        answer=answer(results),
        verdicts=hypothesis_rows(results),
        sections=sections,
        curves=figure_picture(curves, dpi=_DPI) if curves else None,
        notes=notes(results),
        changes={name: _changes(results, name) for name in results.plan.recipes},
        sizes={name: _size(recipe) for name, recipe in results.plan.recipes.items()},
    )


def _size(recipe: Recipe) -> str:
    """Parameters of a model, and Gaussians where queries make them, not pixels."""
    # Without memory: a page needs the shapes alone.
    model = recipe.build_model("meta")
    text = f"{sum(parameter_counts(model).values()) / 1e6:.2f} M parameters"
    if not model.queries.count:
        return text
    return f"{text}, {model.queries.count * model.head.gaussians_per_query:,} Gaussians"


def _changes(results: Results, variant: str) -> dict[str, tuple[str | None, str | None]]:
    """Options of a variant that differ from the reference's, to both values."""
    recipes = results.plan.recipes
    reference = recipes[results.settings.reference]
    changes = differing_options(recipes[variant].tree, reference.tree)
    return {path: values for path, values in changes.items() if path not in BESIDE}
