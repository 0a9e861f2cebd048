"""Tables of `qgs compose` and `qgs diff`: parameters of recipes, and where two differ."""

from rich.markup import escape
from rich.table import Table

from qgs.analysis.shown import parameter_counts
from qgs.composer import Recipe
from qgs.composer.recipe import differing_options
from qgs.model import QueryGaussianModel


def parameter_table(recipe: Recipe, model: QueryGaussianModel) -> Table:
    """Parameters of each component of `model`, built from `recipe`."""
    table = Table("component", "type", "parameters", title="parameters", title_justify="left")
    table.columns[2].justify = "right"
    counts = parameter_counts(model)
    for name, count in counts.items():
        table.add_row(name, _types(recipe, name), f"{count:,}")
    table.add_section()
    table.add_row("total", "", f"{sum(counts.values()):,}")
    return table


def difference_tables(first: Recipe, second: Recipe, a: str, b: str) -> list[Table]:
    """Slots, then options and settings, then parameters that differ in recipes called `a`, `b`.

    "-" stands for an option that a recipe's component does not have.
    """
    differing = differing_options(first.tree, second.tree)
    slots, options, parameters = (
        Table(title=title, title_justify="left")
        for title in ("slots that differ", "options that differ", "parameters")
    )
    for table, what in ((slots, "slot"), (options, "option"), (parameters, "component")):
        justify = "right" if table is parameters else "left"
        table.add_column(what, overflow="fold")
        for header in (a, b):
            table.add_column(escape(header), overflow="fold", justify=justify)
    for path, values in differing.items():
        cells = [escape("-" if value is None else value) for value in values]
        if path.endswith(".type"):
            slots.add_row(path.removesuffix(".type"), *cells)
        else:
            options.add_row(path, *cells)
    parameters.add_column("difference", justify="right", overflow="fold")
    ours, theirs = (parameter_counts(r.build_model("meta")) for r in (first, second))
    rows = [(name, count, theirs[name]) for name, count in ours.items()]
    for name, x, y in [*rows, ("total", sum(ours.values()), sum(theirs.values()))]:
        if name == "total":
            parameters.add_section()
        parameters.add_row(name, f"{x:,}", f"{y:,}", f"{y - x:+,}" if x != y else "")
    return [slots, options, parameters]


def _types(recipe: Recipe, name: str) -> str:
    """The types of a component; of a part of the decoder, those of all layers."""
    slot = name.removeprefix("decoder.")
    path, place = ("model", "decoder", "layers") if slot != name else ("model", slot), slot
    kinds = [c.type for p, c in recipe.parts.items() if p[: len(path)] == path and p[-1] == place]
    return ", ".join(dict.fromkeys(kinds))
