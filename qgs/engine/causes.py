"""Why a run died: the options of its own recipe that are most likely to blame."""

import math
from collections.abc import Iterator, Mapping
from typing import Any

from qgs.composer import Recipe

DOMINANT = 0.5
"""Share of a loss, besides the largest one of the images, above which it is suspected."""

FAINT = 0.01
"""Opacity at the start below which Gaussians are suspected to be hidden by it."""


def blamed(
    recipe: Recipe, last_alive: Mapping[str, float] | None, owners: Mapping[str, str]
) -> tuple[str, bool]:
    """The option of `recipe` that is most likely to blame for a collapse, with its value.

    last_alive: the numbers of the last step with signs of life, None when there never was one.
    owners: names of loss terms to the names of their losses.
    Returns also whether it stands out, so that no other causes need to be thought of.
    """
    found = _from_the_start(recipe) if last_alive is None else _later(recipe, last_alive, owners)
    score, text = max(found, key=lambda suspect: suspect[0])
    return f"most likely in this recipe: {text}", score > STANDS_OUT


STANDS_OUT = 1.0
"""What must be passed, as by more than ten times the default, to blame an option alone."""


def _from_the_start(recipe: Recipe) -> Iterator[tuple[float, str]]:
    """Suspects, with how much speaks against each, of a model that never drew anything."""
    head = recipe.tree["model"]["head"]
    bias, usual = head.get("opacity_bias"), _default(recipe, ("model", "head"), "opacity_bias")
    if isinstance(bias, int | float):
        opacity = 1 / (1 + math.exp(min(-bias, 700.0)))
        yield (
            FAINT / max(opacity, 1e-300),
            f"model.head.opacity_bias is {bias:g} (default {usual}), so that Gaussians start with "
            f"an opacity of {opacity:.1g}",
        )
    cap = head.get("scale_cap")
    small = f", or model.head.scale_cap, {cap:g}," if isinstance(cap, int | float) else ""
    views = recipe.views
    scaled = f"scale_factor is {views.scale_factor:g}" if views.scale != "auto" else "scale is auto"
    yield (
        1.0,
        f"views.{scaled}, which with the places where model.queries start may leave no Gaussian "
        f"before the cameras{small} too small to see",
    )


def _later(
    recipe: Recipe, numbers: Mapping[str, float], owners: Mapping[str, str]
) -> Iterator[tuple[float, str]]:
    """The same of a model that had drawn before it died."""
    options = recipe.tree["optimizer"]
    rate, usual = options.get("learning_rate"), _default(recipe, ("optimizer",), "learning_rate")
    if isinstance(rate, int | float):
        excess = math.log10(rate / usual) if isinstance(usual, float) else 0.0
        yield (
            excess,
            f"optimizer.learning_rate is {rate:g} (default {usual}), reached after "
            f"optimizer.warmup {options.get('warmup', 'none')}: lower the one, lengthen the other",
        )
    yield -1.0, f"the optimiser, {options['type']}: take smaller steps"
    sums: dict[str, float] = {}
    for term, name in owners.items():
        sums[name] = sums.get(name, 0.0) + abs(numbers.get(term, 0.0))
    total = sum(sums.values())
    for name, size in sums.items():
        own = recipe.tree["losses"][name]
        weight, given = own.get("weight"), _default(recipe, ("losses", name), "weight")
        if total and size / total > DOMINANT and isinstance(weight, int | float) and weight > 0:
            excess = math.log10(weight / given) if isinstance(given, float) and given else 0.0
            yield (
                excess + size / total,
                f"losses.{name}.weight is {weight:g} (default {given}); its terms were "
                f"{size / total:.0%} of the loss in the last step with signs of life",
            )


def _default(recipe: Recipe, path: tuple[str, ...], option: str) -> Any:
    """The default of an option of the component at `path`; "none" where there is none."""
    field = recipe.parts[path].component.Config.model_fields.get(option)
    return "none" if field is None or field.is_required() else field.default
