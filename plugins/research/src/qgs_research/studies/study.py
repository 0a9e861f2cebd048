"""Study files: variants, seeds, a budget, evaluations and hypotheses.

Hypotheses such as `A@noisy - A < B@noisy - B` become coefficients of means.
"""

import re
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import (
    AfterValidator,
    Field,
    PositiveFloat,
    PositiveInt,
    ValidationInfo,
    field_validator,
    model_validator,
)

from qgs.contracts import ComponentConfig, OptionError
from qgs.evaluate.evaluation import SECTIONS
from qgs.recipe.decode import decode_config
from qgs.recipe.errors import Problems
from qgs.recipe.files import found_recipe, merge, read_recipe
from qgs.recipe.yaml_text import ListNode, MapNode, items_of
from qgs.wording import did_you_mean

NAME = r"[A-Za-z0-9_][A-Za-z0-9_.]*"
"""Pattern of allowed names of variants and evaluations, which are used as folder names."""

MAIN = ""
"""Name of the default evaluation, whose options are those of the variants' recipes."""

_FORM = "write `A < B` or `A > B`; each side is a variant, or a sum such as `A@EVALUATION - A`"
_TERM = re.compile(rf"\s*([+-]?)\s*({NAME})(?:@({NAME}))?\s*")

_BY_NAME = ("variants", "evaluations", "published")
"""Keys of mappings. An entry replaces only the entry of the same name in the extended study."""


def _folder_name(name: str) -> str:
    if not re.fullmatch(NAME, name):
        fix = "use letters, digits, `_` and `.`, but no `.` at the start"
        raise OptionError(f"{name!r} is not a valid name of a variant or an evaluation", fix)
    return name


def _variant_name(name: str, info: ValidationInfo) -> str:
    # If the variants were refused, no name is known.
    _check_known("variant", name, info.data.get("variants", {name: None}))
    return name


def _evaluation_section(key: str) -> str:
    if key not in SECTIONS:
        fix = f"an evaluation can only set {', '.join(SECTIONS)}"
        raise OptionError(
            f"an evaluation must not set `{key}`, which would change the trained model", fix
        )
    return key


Name = Annotated[str, AfterValidator(_folder_name)]
VariantName = Annotated[str, AfterValidator(_variant_name)]
Section = Annotated[str, AfterValidator(_evaluation_section)]


class Budget(ComponentConfig):
    """Length of each training: a number of steps or a time in seconds."""

    steps: PositiveInt | None = None
    """Number of optimiser steps. Null means that `seconds` limits the training."""
    seconds: PositiveFloat | None = None
    """Training time in seconds. Null means that `steps` limits the training."""

    @model_validator(mode="after")
    def _is_one(self) -> "Budget":
        if (self.steps is None) == (self.seconds is None):
            raise OptionError(
                "a budget needs either steps or seconds, not both", "write `budget: {steps: 2000}`"
            )
        return self


class Hypothesis(ComponentConfig):
    """A statement that compares mean scores of variants, checked when their runs are done."""

    claim: str
    """Statement `A < B` or `A > B`, where A and B are variants. Each side may be a sum such as
    `A@noisy - A`, where `noisy` is the name of an evaluation."""
    metric: str | None = None
    """Metric to compare. Null means the metric of the study."""
    note: str = ""
    """Remark that the table shows beside the verdict, for example the value in a paper."""

    @model_validator(mode="before")
    @classmethod
    def _is_its_claim(cls, written: Any) -> Any:
        return {"claim": written} if isinstance(written, str) else written


def _known_terms(hypothesis: Hypothesis, info: ValidationInfo) -> Hypothesis:
    if {"variants", "evaluations"} <= info.data.keys():
        parsed(hypothesis.claim, info.data["variants"], info.data["evaluations"])
    return hypothesis


class StudySettings(ComponentConfig):
    """Content of a study file, merged with the study files that it extends.

    Variants and evaluations come before the fields whose validators read them.
    """

    study: int = Field(ge=1, le=1)
    """Version of the study format, always 1."""
    title: str = ""
    """Heading of the results page. An empty text means the name of the study file."""
    question: str = ""
    """Question that the study answers, in one or more sentences."""
    base: Any = None
    """Recipe file that the variants change, or a list in which each file changes the files before
    it. Null means that every variant names its own recipe by `extends`."""
    overlay: dict[str, Any] = Field(default_factory=dict)
    """Recipe options to set in all variants, written in sections as in a recipe file."""
    variants: dict[Name, dict[str, Any] | None] = Field(min_length=1, max_length=200)
    """Models to compare, by name. Each is a recipe file or a set of changes to `base`; null means
    `base` without changes."""
    evaluations: dict[Name, dict[Section, Any]] = Field(default_factory=dict)
    """Additional evaluations of every model, by name. Each evaluation sets recipe options, such as
    other data or views, and keeps all other options of the variant."""
    seeds: tuple[int, ...] = Field(default=(0, 1, 2), min_length=1)
    """Random seeds; each variant is trained once with each seed. A seed determines the initial
    weights and the order of the data."""
    reference: VariantName
    """Variant with which all other variants are compared."""
    budget: Budget
    """Length of each training, the same for all variants."""
    metric: str = "psnr"
    """Name of the metric that decides which variant is better."""
    differs: tuple[str, ...] = ()
    """Options, outside the sections model and optimizer, in which variants may differ, such as
    `training.batch_size`."""
    hypotheses: tuple[Annotated[Hypothesis, AfterValidator(_known_terms)], ...] = ()
    """Statements to check. Each is a text such as `A > B`, or a mapping with this text under the
    key `claim`."""
    published: dict[VariantName, float] = Field(default_factory=dict)
    """Published values of the metric, by variant. The table shows them beside the measured values.
    A note gives the rank correlation of published and measured values."""

    @field_validator("seeds")
    @classmethod
    def _seeds_differ(cls, seeds: tuple[int, ...]) -> tuple[int, ...]:
        if len(set(seeds)) < len(seeds) or min(seeds) < 0:
            raise OptionError(
                f"seeds must be different integers of at least 0, got {list(seeds)}",
                "write `seeds: [0, 1]`",
            )
        return seeds


Terms = Mapping[tuple[str, str], int]
"""Weighted sum of mean scores: the weight of each mean, by (variant, evaluation)."""


def parsed(text: str, variants: Collection[str], evaluations: Collection[str]) -> tuple[Terms, int]:
    """Parse a hypothesis such as `A < B`; return the left side minus the right side, and a sign.

    The sign is that of this sum if the hypothesis is true: 1 for `>` and -1 for `<`. Raises
    OptionError for a text of another form, and for unknown variants or evaluations.
    """
    sides = re.split(r"\s*([<>])\s*", text.strip())
    if len(sides) != 3:
        raise OptionError(f"`{text}` needs exactly one `<` or `>`", _FORM)
    left, comparison, right = sides
    sums = Counter[tuple[str, str]]()
    for side, factor in ((left, 1), (right, -1)):
        matches = [*_TERM.finditer(side)]
        # A side has only terms, with a sign before each except the first.
        whole = "".join(match[0] for match in matches) == side and side
        if not whole or any(not match[1] for match in matches[1:]):
            raise OptionError(f"`{side}` in `{text}` is not a sum of variants", _FORM)
        for sign, variant, evaluation in (match.groups() for match in matches):
            _check_known("variant", variant, variants, f"`{text}`: ")
            if evaluation:
                _check_known("evaluation", evaluation, evaluations, f"`{text}`: ")
            sums[variant, evaluation or MAIN] += -factor if sign == "-" else factor
    # A sum that does not cancel would depend on the data set, not on the variants.
    if sums.total():
        raise OptionError(
            f"the sides of `{text}` have different sums, counting 1 per variant and -1 after a `-`",
            "write a variant on each side, or a difference, such as `A@noisy - A < B@noisy - B`",
        )
    terms = {term: coefficient for term, coefficient in sums.items() if coefficient}
    if not terms:
        raise OptionError(f"both sides of `{text}` are equal, so nothing is compared", _FORM)
    return terms, -1 if comparison == "<" else 1


def _check_known(noun: str, name: str, known: Collection[str], where: str = "") -> None:
    if name not in known:
        fix = did_you_mean(name, known, f"{noun}s")
        raise OptionError(f"{where}there is no {noun} `{name}`", fix)


@dataclass(frozen=True)
class Study:
    """A study, as read from `file`.

    variants: the recipe of each variant, as input of `qgs.recipe.resolve`. evaluations: changes to
    the recipe of a trained variant, by name of the evaluation. Both mappings keep the file and line
    of each value.
    """

    file: Path
    settings: StudySettings
    variants: Mapping[str, MapNode]
    evaluations: Mapping[str, MapNode]


def read_study(file: str | Path) -> Study:
    """Read the study in `file`, which is a path or the name of a study that comes with qgs.

    The recipes of the variants are not checked yet. Raises RecipeError that lists all faults of the
    study with file and line.
    """
    problems = Problems("study")
    found = found_recipe(Path(file), str(file))
    tree = read_recipe(found, problems, _merged)
    for name, written, origin in tree.child("variants").entries():
        # A file name stands for a recipe that changes nothing in that file.
        if isinstance(written, str):
            tree["variants"][name] = MapNode(origin, [("extends", written, origin)])
    settings = decode_config(StudySettings, tree, (), problems)
    problems.raise_any()
    assert settings is not None
    variants = {name: _variant(tree, name, problems) for name in settings.variants}
    problems.raise_any()
    evaluations: Any = dict(tree.child("evaluations"))
    for node in evaluations.values():
        _locate_index(node)
    return Study(file=found, settings=settings, variants=variants, evaluations=evaluations)


def _merged(base: MapNode, study: MapNode) -> MapNode:
    """Merge a study into the study `base`, which it extends."""
    merged = MapNode(study.origin, base.entries())
    for key, value, origin in study.entries():
        old = base.get(key)
        if isinstance(old, MapNode) and isinstance(value, MapNode):
            if key == "overlay":
                value = merge(old, value)
            elif key in _BY_NAME:
                # Null removes an entry, but a new variant that is null is the base itself.
                dropped = [name for name in value if value[name] is None and name in old]
                kept = old.without(*value).entries()
                value = MapNode(origin, [*kept, *value.without(*dropped).entries()])
        merged.put(key, value, origin)
    return merged


def _variant(tree: MapNode, name: str, problems: Problems) -> MapNode:
    """Return the recipe of a variant: `base`, changed by the variant, then by `overlay`."""
    variants = tree.child("variants")
    origin = variants.origins[name]
    node = variants.child(name)
    holder, key = (node, "extends") if "extends" in node else (tree, "base")
    if holder.get(key) is None:
        reason = f"`{name}` has no recipe of its own, and the study has no `base`"
        fix = "add `base: RECIPE.yaml`, or `extends` here"
        problems.add(origin, f"variants.{name}", reason, fix)
        return node
    files = []
    at = holder.origins[key]
    for recipe, line in items_of(holder[key], at):
        file = found_recipe(Path(at.file).parent / recipe, recipe).resolve()
        if not file.exists():
            option = "base" if holder is tree else f"variants.{name}.extends"
            fix = "check the path, or take one of `qgs recipes`"
            problems.add(line, option, f"there is no recipe {file}", fix)
        files.append((str(file), line))
    overlay = tree.child("overlay")
    _locate_index(overlay)
    whole = merge(node.without("extends"), overlay)
    extends = ("extends", ListNode(files), at)
    return MapNode(origin, [extends, ("recipe", 1, origin), *whole.entries()])


def _locate_index(node: MapNode) -> None:
    """Make the path `evaluation.index` absolute if, relative to the study file, it names a file."""
    section = node.child("evaluation")
    index = section.get("index")
    if isinstance(index, str):
        file = Path(section.origins["index"].file).parent / index
        # Otherwise the path is relative to the working directory, as in a recipe.
        if file.is_file():
            section["index"] = str(file.resolve())
