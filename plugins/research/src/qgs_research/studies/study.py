"""A study as it is written: variants, seeds, a budget, evaluations, hypotheses."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeAlias

from pydantic import AfterValidator, Field, field_validator, model_validator

from qgs.contracts import ComponentConfig, OptionError
from qgs.evaluate.evaluation import SECTIONS
from qgs.paths import open_file
from qgs.recipe.decode import decode_config
from qgs.recipe.errors import Origin, Problems, did_you_mean
from qgs.recipe.files import found_recipe, merge
from qgs.recipe.yaml_text import ListNode, MapNode, kind_of, load_mapping
from qgs_research.studies.hypotheses import NAME, Contrast, parsed


def _folder_name(name: str) -> str:
    if not re.fullmatch(NAME, name):
        fix = "use letters, digits, `_` and `.`, the first one no `.`"
        raise OptionError(f"{name!r} cannot be a folder or stand in hypotheses", fix)
    return name


Name: TypeAlias = Annotated[str, AfterValidator(_folder_name)]


class Budget(ComponentConfig):
    """What each run may use: one of the three."""

    steps: int | None = Field(default=None, ge=1)
    """Optimiser steps: the only budget that a busy machine does not change."""
    seconds: float | None = Field(default=None, gt=0)
    """Seconds on the clock of training; how many steps that were is shown."""
    images: int | None = Field(default=None, ge=1)
    """Target images that are rendered and judged in training, all steps together."""

    @model_validator(mode="after")
    def _is_one(self) -> "Budget":
        given = [n for n in type(self).model_fields if getattr(self, n) is not None]
        if len(given) != 1:
            raise OptionError(
                f"a budget is one of steps, seconds and images, got {len(given)} of them",
                "write `budget: {steps: 2000}`",
            )
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


class StudySettings(ComponentConfig):
    """A study as its file has it, with the files that it extends."""

    study: int = Field(ge=1, le=1)
    """Version of the format."""
    title: str = ""
    """Heading of the page; empty takes the file's name."""
    question: str = ""
    """What the study is to answer, in a sentence or more."""
    seeds: tuple[int, ...] = Field(default=(0, 1, 2), min_length=1)
    """One run of each variant for each: the model's start, and which data it sees in what order."""
    reference: str
    """The variant that the others are held against."""
    budget: Budget
    """The same for all variants."""
    metric: str = "psnr"
    """The value that decides, as evaluations call it."""
    differs: tuple[str, ...] = ()
    """Options of data, views, training, evaluation and metrics in which variants may differ."""
    hypotheses: tuple[Hypothesis, ...] = ()
    """What is expected; a text stands for its claim."""
    base: Any = None
    """Recipe, or several laid over each other, that variants are laid over."""
    overlay: dict[str, Any] = Field(default_factory=dict)
    """Part of a recipe that is laid over every variant."""
    variants: dict[Name, Any] = Field(min_length=1, max_length=200)
    """A recipe file, or the part of a recipe, by name. Each takes a tenth of a second to check."""
    evaluations: dict[Name, dict[str, Any]] = Field(default_factory=dict)
    """What is changed before every trained model is judged once more, by name."""
    published: dict[str, float] = Field(default_factory=dict)
    """The metric as published, by variant: shown beside ours, with the rank correlation."""

    @field_validator("variants", "evaluations")
    @classmethod
    def _folders_differ(cls, named: dict[str, Any]) -> dict[str, Any]:
        names = {name.lower(): name for name in named}
        if same := [name for name in named if names[name.lower()] != name]:
            raise OptionError(
                f"`{same[0]}` and `{names[same[0].lower()]}` are one folder where file names have "
                "no case",
                "give them other names",
            )
        return named

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
    trained recipe before its model is judged once more. contrasts: of `settings.hypotheses`.
    """

    file: Path
    settings: StudySettings
    variants: Mapping[str, MapNode]
    evaluations: Mapping[str, MapNode]
    contrasts: Sequence[Contrast]
    origins: Mapping[str, Origin]

    @property
    def title(self) -> str:
        """The heading."""
        return self.settings.title or self.file.stem.replace("_", " ")


def read_study(file: str | Path) -> Study:
    """Return the study in `file`, or the one of that name that comes with qgs.

    Nothing is composed yet. Raises RecipeError with all that is wrong with it, by file and line.
    """
    problems = Problems("study")
    found = found_recipe(Path(file), str(file))
    tree = _read(found, problems, ())
    # A file that cannot be read hides what else is wrong.
    problems.raise_if_stopped()
    settings = decode_config(StudySettings, tree, (), problems)
    variants = _variants(tree, problems)
    problems.raise_any()
    assert settings is not None
    _check_names(settings, tree, problems)
    contrasts = _contrasts(settings, tree, problems)
    problems.raise_any()
    evaluations: Any = dict(tree.child("evaluations"))
    return Study(
        file=found,
        settings=settings,
        variants=variants,
        evaluations=evaluations,
        contrasts=contrasts,
        origins=tree.child("variants").origins,
    )


def _read(file: Path, problems: Problems, chain: tuple[Path, ...]) -> MapNode:
    """The tree of `file` over that of the study that it extends, names of files made absolute."""
    origin = Origin(str(file))
    try:
        with open_file(file) as opened:
            text = opened.read().decode("utf-8")
    except (OSError, ValueError) as error:
        fix = "check the path, or take one such as studies/tiny/structural.yaml"
        problems.stop(origin, "study", f"{file} cannot be read: {error}", fix)
        return MapNode(origin)
    tree = load_mapping(text, str(file), problems)
    # Before the files are merged: names are relative to the file that has them.
    _locate_files(tree, file.parent, problems)
    base = tree.get("extends")
    if base is None:
        return tree
    if not isinstance(base, str) or file in chain:
        reason = "`extends` names one other study, and no circle of them"
        fix = "write `extends: other.yaml`, relative to this file"
        problems.stop(tree.origins["extends"], "extends", reason, fix)
        return tree
    under = _read(found_recipe(file.parent / base, base), problems, (*chain, file))
    return _merged(under, tree.without("extends"))


def _merged(base: MapNode, over: MapNode) -> MapNode:
    """Keys of `over` replace those of `base`; of variants and evaluations each by its name.

    A variant or evaluation that is null is left out.
    """
    entries = {key: (key, value, origin) for key, value, origin in base.entries()}
    for key, value, origin in over.entries():
        old = base.get(key)
        if isinstance(old, MapNode) and isinstance(value, MapNode):
            if key == "overlay":
                value = merge(old, value)
            elif key in ("variants", "evaluations", "published"):
                dropped = [name for name in value if value[name] is None and name in old]
                kept = old.without(*value).entries()
                value = MapNode(origin, [*kept, *value.without(*dropped).entries()])
        entries[key] = (key, value, origin)
    return MapNode(over.origin, entries.values())


def _locate_files(tree: MapNode, folder: Path, problems: Problems) -> None:
    """Make names of recipes and indices in `tree`, relative to `folder`, hold anywhere."""

    def located(written: Any, at: Origin, option: str) -> Any:
        if isinstance(written, ListNode):
            names = zip(written, written.origins, strict=True)
            return ListNode(at, [(located(name, origin, option), origin) for name, origin in names])
        # Other kinds are refused where the recipe is composed.
        if not isinstance(written, str):
            return written
        file = found_recipe(folder / written, written).resolve()
        if not file.exists():
            fix = "check the path, or take one of `qgs recipes`"
            problems.stop(at, option, f"there is no recipe {file}", fix)
        return str(file)

    if "base" in tree:
        tree["base"] = located(tree["base"], tree.origins["base"], "base")
    variants = tree.child("variants")
    for name, node, origin in variants.entries():
        # A file name is a recipe that changes nothing of that file.
        if isinstance(node, str):
            node = MapNode(origin, [("extends", node, origin)])
            variants[name] = node
        if isinstance(node, MapNode) and "extends" in node:
            at = node.origins["extends"]
            node["extends"] = located(node["extends"], at, f"variants.{name}.extends")
    for node in (tree.child("overlay"), *tree.child("evaluations").values()):
        section = node.child("evaluation") if isinstance(node, MapNode) else MapNode(tree.origin)
        index = section.get("index")
        # Otherwise it is relative to the working directory, as in a recipe.
        if isinstance(index, str) and (folder / index).is_file():
            section["index"] = str((folder / index).resolve())


def _variants(tree: MapNode, problems: Problems) -> dict[str, MapNode]:
    """By name: the base or what a variant extends, the variant, the overlay."""
    found: dict[str, MapNode] = {}
    for name, written, origin in tree.child("variants").entries():
        option = f"variants.{name}"
        node = MapNode(origin) if written is None else written
        if not isinstance(node, MapNode):
            reason = f"a variant is a recipe or the part of one, this is {kind_of(node)}"
            problems.add(origin, option, reason, "write a recipe's file name, or a mapping")
            continue
        holder, key = (node, "extends") if "extends" in node else (tree, "base")
        if holder.get(key) is None:
            reason = f"`{name}` has neither a recipe of its own nor a `base` to be laid over"
            problems.add(origin, option, reason, "add `base: RECIPE.yaml`, or `extends` here")
            continue
        whole = merge(node.without("extends"), tree.child("overlay"))
        first = [("extends", holder[key], holder.origins[key]), ("recipe", 1, origin)]
        found[name] = MapNode(origin, [*first, *whole.entries()])
    return found


def _check_names(settings: StudySettings, tree: MapNode, problems: Problems) -> None:
    """Report names of variants that there are not, and evaluations that change the model."""
    named = [("reference", settings.reference, tree.origins["reference"])]
    for name, _, origin in tree.child("published").entries():
        named.append((f"published.{name}", name, origin))
    for option, name, at in named:
        if name not in settings.variants:
            fix = did_you_mean(name, settings.variants, "variants")
            problems.add(at, option, f"there is no variant `{name}`", fix)
    for name, node in tree.child("evaluations").items():
        for key in [key for key in node if key not in SECTIONS]:
            reason = f"`{key}` would change the trained model"
            fix = f"an evaluation can only set {', '.join(SECTIONS)}"
            problems.add(node.origins[key], f"evaluations.{name}.{key}", reason, fix)


def _contrasts(settings: StudySettings, tree: MapNode, problems: Problems) -> list[Contrast]:
    found = []
    for number, hypothesis in enumerate(settings.hypotheses):
        try:
            found.append(parsed(hypothesis.claim, settings.variants, settings.evaluations))
        except OptionError as error:
            at = tree["hypotheses"].origins[number]
            problems.add(at, f"hypotheses.{number}", error.reason, error.fix)
    return found
