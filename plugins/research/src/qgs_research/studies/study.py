"""A study as it is written: variants, seeds, a budget, evaluations, hypotheses."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, TypeAlias

from pydantic import AfterValidator, Field, ValidationInfo, field_validator, model_validator

from qgs.contracts import ComponentConfig, OptionError
from qgs.evaluate.evaluation import SECTIONS
from qgs.paths import open_file
from qgs.recipe.decode import decode_config
from qgs.recipe.errors import Origin, Problems
from qgs.recipe.files import found_recipe, merge
from qgs.recipe.yaml_text import ListNode, MapNode, load_mapping
from qgs.wording import did_you_mean
from qgs_research.studies.hypotheses import NAME, Contrast, parsed

_BY_NAME = ("variants", "evaluations", "published")
"""Keys whose entries a study that extends another replaces one by one."""


def _folder_name(name: str) -> str:
    if not re.fullmatch(NAME, name):
        fix = "use letters, digits, `_` and `.`, the first one no `.`"
        raise OptionError(f"{name!r} cannot be a folder or stand in hypotheses", fix)
    return name


def _variant_name(name: str, info: ValidationInfo) -> str:
    # Without variants, which were refused, no name is known.
    variants = info.data.get("variants", {name: None})
    if name not in variants:
        fix = did_you_mean(name, variants, "variants")
        raise OptionError(f"there is no variant `{name}`", fix)
    return name


def _evaluation_section(key: str) -> str:
    if key not in SECTIONS:
        fix = f"an evaluation can only set {', '.join(SECTIONS)}"
        raise OptionError(f"`{key}` would change the trained model", fix)
    return key


Name: TypeAlias = Annotated[str, AfterValidator(_folder_name)]
VariantName: TypeAlias = Annotated[str, AfterValidator(_variant_name)]
Section: TypeAlias = Annotated[str, AfterValidator(_evaluation_section)]


class Budget(ComponentConfig):
    """What each run may use: one of the two."""

    steps: int | None = Field(default=None, ge=1)
    """Optimiser steps: the only budget that a busy machine does not change."""
    seconds: float | None = Field(default=None, gt=0)
    """Seconds on the clock of training; how many steps that were is shown."""

    @model_validator(mode="after")
    def _is_one(self) -> "Budget":
        if (self.steps is None) == (self.seconds is None):
            raise OptionError("a budget is steps or seconds", "write `budget: {steps: 2000}`")
        return self


class Hypothesis(ComponentConfig):
    """A claim about means, checked when the runs are done."""

    claim: str
    """`A < B` or `A > B` of variants; each side may be a sum such as `A@noisy - A`, with the name
    of an evaluation behind the @."""
    metric: str | None = None
    """What is compared; null for the study's metric."""
    note: str = ""
    """What else is to be known, such as what a paper says; shown beside the verdict."""

    @model_validator(mode="before")
    @classmethod
    def _is_its_claim(cls, written: Any) -> Any:
        return {"claim": written} if isinstance(written, str) else written


def _known_terms(hypothesis: Hypothesis, info: ValidationInfo) -> Hypothesis:
    if {"variants", "evaluations"} <= info.data.keys():
        parsed(hypothesis.claim, info.data["variants"], info.data["evaluations"])
    return hypothesis


class StudySettings(ComponentConfig):
    """A study as its file has it, with the files that it extends.

    A field is checked against those before it: variants and evaluations come first.
    """

    study: int = Field(ge=1, le=1)
    """Version of the format."""
    title: str = ""
    """Heading of the page; empty takes the file's name."""
    question: str = ""
    """What the study is to answer, in a sentence or more."""
    base: Any = None
    """Recipe, or several laid over each other, that variants are laid over."""
    overlay: dict[str, Any] = Field(default_factory=dict)
    """Part of a recipe that is laid over every variant."""
    variants: dict[Name, dict[str, Any] | None] = Field(min_length=1, max_length=200)
    """A recipe file, or the part of a recipe, by name. Each takes a tenth of a second to check."""
    evaluations: dict[Name, dict[Section, Any]] = Field(default_factory=dict)
    """What is changed before every trained model is judged once more, by name."""
    seeds: tuple[int, ...] = Field(default=(0, 1, 2), min_length=1)
    """One run of each variant for each: the model's start, and which data it sees in what order."""
    reference: VariantName
    """The variant that the others are held against."""
    budget: Budget
    """The same for all variants."""
    metric: str = "psnr"
    """The value that decides, as evaluations call it."""
    differs: tuple[str, ...] = ()
    """Options of data, views, training, evaluation and metrics in which variants may differ."""
    hypotheses: tuple[Annotated[Hypothesis, AfterValidator(_known_terms)], ...] = ()
    """What is expected; a text stands for its claim."""
    published: dict[VariantName, float] = Field(default_factory=dict)
    """The metric as published, by variant: shown beside ours, with the rank correlation."""

    @field_validator("seeds")
    @classmethod
    def _seeds_differ(cls, seeds: tuple[int, ...]) -> tuple[int, ...]:
        if len(set(seeds)) < len(seeds) or min(seeds) < 0:
            raise OptionError(
                f"must be different numbers from 0 on, got {list(seeds)}", "write `seeds: [0, 1]`"
            )
        return seeds


@dataclass(frozen=True)
class Study:
    """A study that was read. file: where it is written.

    variants: by name what `qgs.recipe.resolve` takes. evaluations: by name what is laid over a
    trained recipe before its model is judged once more. Both know where they are written.
    """

    file: Path
    settings: StudySettings
    variants: Mapping[str, MapNode]
    evaluations: Mapping[str, MapNode]

    @property
    def title(self) -> str:
        """The heading."""
        return self.settings.title or self.file.stem.replace("_", " ")

    @cached_property
    def contrasts(self) -> Sequence[Contrast]:
        """The hypotheses as sums of means."""
        claims = [hypothesis.claim for hypothesis in self.settings.hypotheses]
        return [parsed(claim, self.variants, self.evaluations) for claim in claims]


def read_study(file: str | Path) -> Study:
    """Return the study in `file`, or the one of that name that comes with qgs.

    Nothing is composed yet. Raises RecipeError with all that is wrong with it, by file and line.
    """
    problems = Problems("study")
    found = found_recipe(Path(file), str(file))
    tree = _read(found, problems, ())
    for name, written, origin in tree.child("variants").entries():
        # A file name is a recipe that changes nothing of that file.
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


def _read(file: Path, problems: Problems, chain: tuple[Path, ...]) -> MapNode:
    """Return the tree of `file` over that of the study that it extends."""
    try:
        with open_file(file) as opened:
            text = opened.read().decode("utf-8")
    except (OSError, ValueError) as error:
        fix = "check the path, or take one such as studies/tiny/structural.yaml"
        problems.stop(Origin(str(file)), "study", f"{file} cannot be read: {error}", fix)
    tree = load_mapping(text, str(file), problems)
    extended = tree.get("extends")
    if extended is None:
        return tree
    if not isinstance(extended, str) or file in chain:
        reason = "`extends` names one other study, and no circle of them"
        fix = "write `extends: other.yaml`, relative to this file"
        problems.stop(tree.origins["extends"], "extends", reason, fix)
    base = _read(found_recipe(file.parent / extended, extended), problems, (*chain, file))
    for key, value, origin in tree.without("extends").entries():
        old = base.get(key)
        if isinstance(old, MapNode) and isinstance(value, MapNode):
            if key == "overlay":
                value = merge(old, value)
            elif key in _BY_NAME:
                # Null drops an entry; a variant that is new and null is the base itself.
                dropped = [name for name in value if value[name] is None and name in old]
                kept = old.without(*value).entries()
                value = MapNode(origin, [*kept, *value.without(*dropped).entries()])
        base[key] = value
        base.origins[key] = origin
    return base


def _variant(tree: MapNode, name: str, problems: Problems) -> MapNode:
    """Return the recipe of a variant: the base or what it extends, the variant, the overlay."""
    variants = tree.child("variants")
    origin = variants.origins[name]
    node = variants.child(name)
    holder, key = (node, "extends") if "extends" in node else (tree, "base")
    if holder.get(key) is None:
        reason = f"`{name}` has neither a recipe of its own nor a `base` to be laid over"
        fix = "add `base: RECIPE.yaml`, or `extends` here"
        problems.add(origin, f"variants.{name}", reason, fix)
        return node
    at = holder.origins[key]
    written = holder[key]
    files = []
    for recipe in written if isinstance(written, list) else [written]:
        file = found_recipe(Path(at.file).parent / recipe, recipe).resolve()
        if not file.exists():
            option = "base" if holder is tree else f"variants.{name}.extends"
            fix = "check the path, or take one of `qgs recipes`"
            problems.add(at, option, f"there is no recipe {file}", fix)
        files.append((str(file), at))
    overlay = tree.child("overlay")
    _locate_index(overlay)
    whole = merge(node.without("extends"), overlay)
    extends = ("extends", ListNode(files), at)
    return MapNode(origin, [extends, ("recipe", 1, origin), *whole.entries()])


def _locate_index(node: MapNode) -> None:
    """Make the name of an index hold anywhere: it may be relative to the study that has it."""
    section = node.child("evaluation")
    index = section.get("index")
    if isinstance(index, str):
        file = Path(section.origins["index"].file).parent / index
        # Otherwise it is relative to the working directory, as in a recipe.
        if file.is_file():
            section["index"] = str(file.resolve())
