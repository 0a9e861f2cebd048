"""A study as it is written: variants, seeds, a budget, evaluations, hypotheses."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import Field, field_validator, model_validator

from qgs.composer.decode import decode_config
from qgs.composer.errors import Origin, Problems, did_you_mean, nearest
from qgs.composer.files import found_recipe, merge, recipe_folder
from qgs.composer.yaml_text import ListNode, MapNode, kind_of, load_mapping
from qgs.contracts import ComponentConfig, OptionError
from qgs.engine.evaluation import SECTIONS
from qgs_studies.hypotheses import NAME, Contrast, parsed

MAX_EXTENDED = 8
"""Studies that extend each other."""


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


class StudySettings(ComponentConfig):
    """All of a study but its recipes."""

    study: Literal[1]
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
    published: dict[str, float] = Field(default_factory=dict)
    """The metric as published, by variant: shown beside ours, with the rank correlation."""

    @field_validator("seeds")
    @classmethod
    def _seeds_differ(cls, seeds: tuple[int, ...]) -> tuple[int, ...]:
        if len(set(seeds)) < len(seeds) or min(seeds) < 0:
            raise OptionError(
                f"must be different numbers from 0 on, got {list(seeds)}", "write `seeds: [0, 1]`"
            )
        return seeds


_BESIDE = ("base", "overlay", "variants", "evaluations")
"""Keys of a study that hold recipes, or parts of them."""


@dataclass(frozen=True)
class Study:
    """A study that was read. file: where it is written.

    variants: by name what `qgs.composer.resolve` takes. evaluations: by name what is laid over a
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
    """The study in `file`, or the one of that name that comes with qgs; nothing is composed yet.

    Raises RecipeError with all that is wrong with it, by file and line.
    """
    problems = Problems("study")
    found = found_recipe(Path(file), str(file))
    tree = _read(found, problems, ())
    problems.raise_if_stopped()
    settings = _settings(tree, problems)
    variants = _variants(tree, problems)
    evaluations = _evaluations(tree, problems)
    problems.raise_any()
    assert settings is not None
    _check_names(settings, variants, tree, problems)
    contrasts = _contrasts(settings, tree, [*variants], [*evaluations], problems)
    problems.raise_any()
    origins = {n: tree.child("variants").origins[n] for n in variants}
    return Study(found, settings, variants, evaluations, contrasts, origins)


def _read(file: Path, problems: Problems, chain: tuple[Path, ...]) -> MapNode:
    """The tree of `file` laid over the study that it extends, names of files made absolute."""
    origin = Origin(str(file))
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        fix = _meant(str(file), "studies/*/*.yaml", "studies/tiny/structural.yaml")
        option = "extends" if chain else "study"
        problems.stop(origin, option, f"{file} cannot be read: {why}", fix)
        return MapNode(origin)
    tree = _absolute(load_mapping(text, str(file), problems), file.parent, problems)
    base = tree.get("extends")
    if base is None:
        return tree
    at = tree.origins["extends"]
    if not isinstance(base, str) or len(chain) >= MAX_EXTENDED:
        reason = "`extends` of a study names one other study, of which at most 8 follow each other"
        problems.stop(at, "extends", reason, "write `extends: other.yaml`, relative to this file")
        return tree
    under = _read(found_recipe(file.parent / base, base), problems, (*chain, file))
    return _laid(under, tree.without("extends"))


def _meant(name: str, pattern: str, example: str) -> str:
    """What to do where there is no file `name`: those that come with qgs match `pattern`."""
    home = recipe_folder()
    shipped = [file.relative_to(home) for file in home.glob(pattern)]
    stem = nearest(Path(name).stem, (file.stem for file in shipped))
    end = "/".join(Path(name).parts[-pattern.count("/") - 1 :])  # whatever folder that lies in
    near = nearest(end, (file.as_posix() for file in shipped if file.stem == stem))
    return f"did you mean `{near}`?" if near else f"check the path, or take one such as {example}"


def _laid(base: MapNode, over: MapNode) -> MapNode:
    """Keys of `over` replace those of `base`; of variants and evaluations each by its name."""
    merged = MapNode(over.origin, base.entries())
    for key, value, origin in over.entries():
        old = merged.get(key)
        if key in ("variants", "evaluations", "published") and isinstance(old, MapNode):
            value = _named(old, value) if isinstance(value, MapNode) else value
        elif key == "overlay" and isinstance(old, MapNode) and isinstance(value, MapNode):
            value = merge(old, value)
        merged[key], merged.origins[key] = value, origin
    return merged


def _named(base: MapNode, over: MapNode) -> MapNode:
    """Both, those of `over` in place of the others of their name; null leaves one out."""
    dropped = [name for name, value in over.items() if value is None and name in base]
    kept = (entry for entry in base.entries() if entry[0] not in over)
    return MapNode(over.origin, [*kept, *over.without(*dropped).entries()])


def _absolute(tree: MapNode, folder: Path, problems: Problems) -> MapNode:
    """`tree` whose names of recipes, relative to `folder`, are paths that hold anywhere.

    So is the name of an evaluation index, where it is relative to `folder` and not to the working
    directory.
    """

    def paths(node: object, origin: Origin, option: str) -> ListNode:
        items = node if isinstance(node, ListNode) else ListNode(origin, [(node, origin)])
        found = []
        for item, at in zip(items, items.origins, strict=True):
            if isinstance(item, str):
                file = found_recipe(folder / item, item).resolve()
                found.append((str(file), at))
                if not file.exists():
                    fix = _meant(item, "*/*.yaml", "tiny/locus.yaml (`qgs recipes` has all)")
                    problems.stop(at, option, f"there is no recipe {file}", fix)
            else:
                reason = f"`{option}` names recipe files, this is {kind_of(item)}"
                problems.stop(at, option, reason, f"write `{option}: FILE.yaml`")
        return ListNode(origin, found)

    if tree.get("base") is not None:
        tree["base"] = paths(tree["base"], tree.origins["base"], "base")
    for name, node, origin in tree.child("variants").entries():
        option = f"variants.{name}"
        if isinstance(node, str):
            made = MapNode(origin, [("extends", paths(node, origin, option), origin)])
            tree["variants"][name] = made
        elif isinstance(node, MapNode) and node.get("extends") is not None:
            at = node.origins["extends"]
            node["extends"] = paths(node["extends"], at, f"{option}.extends")
    for node in (tree.child("overlay"), *(n for n in tree.child("evaluations").values())):
        section = node.child("evaluation") if isinstance(node, MapNode) else MapNode(tree.origin)
        index = section.get("index")
        if isinstance(index, str) and (folder / index).is_file():
            section["index"] = str((folder / index).resolve())
    return tree


def _settings(tree: MapNode, problems: Problems) -> StudySettings | None:
    node = tree.without(*_BESIDE)
    written = node.get("hypotheses")
    if isinstance(written, ListNode):
        claims = [
            (MapNode(at, [("claim", item, at)]) if isinstance(item, str) else item, at)
            for item, at in zip(written, written.origins, strict=True)
        ]
        node["hypotheses"] = ListNode(written.origin, claims)
    known = {*StudySettings.model_fields, *_BESIDE, "extends"}
    for key in [key for key in node if key not in known]:
        fix = did_you_mean(key, known, "keys")
        problems.add(node.origins[key], key, f"there is no key `{key}` here", fix)
        node = node.without(key)
    return decode_config(StudySettings, node, (), problems)


def _mapping(tree: MapNode, key: str, problems: Problems) -> MapNode:
    """The mapping under `key`, of names that a folder can have; an empty one where it is absent."""
    node = tree.get(key)
    if node is not None and not isinstance(node, MapNode):
        reason = f"`{key}` is a mapping, this is {kind_of(node)}"
        problems.add(tree.origins[key], key, reason, f"write `name: ...` lines below `{key}:`")
    kept = []
    for name, value, origin in tree.child(key).entries():
        if re.fullmatch(NAME, name):
            kept.append((name, value, origin))
        else:
            reason = f"{name!r} is to be the name of a folder and to stand in hypotheses"
            fix = "use letters, digits, `_` and `.`, the first one no `.`"
            problems.add(origin, f"{key}.{name}", reason, fix)
    return MapNode(tree.child(key).origin, kept)


def _variants(tree: MapNode, problems: Problems) -> dict[str, MapNode]:
    """By name: the base or what a variant extends, the variant, the overlay."""
    found, base = {}, tree.get("base")
    overlay = tree.child("overlay")
    if "overlay" in tree and not isinstance(tree["overlay"], MapNode):
        reason = "`overlay` is the part of a recipe that is laid over every variant"
        problems.add(tree.origins["overlay"], "overlay", reason, "write a mapping")
    if "extends" in overlay:
        reason = "`overlay` extends nothing: it is laid over what variants extend"
        problems.add(overlay.origins["extends"], "overlay.extends", reason, "use `base`")
    for name, node, origin in _mapping(tree, "variants", problems).entries():
        option = f"variants.{name}"
        if node is None:
            node = MapNode(origin)
        if not isinstance(node, MapNode):
            reason = f"a variant is a recipe or the part of one, this is {kind_of(node)}"
            problems.add(origin, option, reason, "write a recipe's file name, or a mapping")
            continue
        extends = node.get("extends", base)
        if extends is None:
            reason = f"`{name}` has neither a recipe of its own nor a `base` to be laid over"
            problems.add(origin, option, reason, "add `base: RECIPE.yaml`, or `extends` here")
            continue
        at = node.origins.get("extends", tree.origins.get("base", origin))
        whole = merge(node.without("extends"), overlay)
        recipe = ("recipe", whole.get("recipe", 1), origin)
        kept = whole.without("recipe").entries()
        found[name] = MapNode(origin, [("extends", extends, at), recipe, *kept])
    if not found and not tree.child("variants"):
        reason, fix = "the study has no variants", "add `variants: {name: RECIPE.yaml}`"
        problems.add(tree.origins.get("variants", tree.origin), "variants", reason, fix)
    return found


def _evaluations(tree: MapNode, problems: Problems) -> dict[str, MapNode]:
    found = {}
    for name, node, origin in _mapping(tree, "evaluations", problems).entries():
        option = f"evaluations.{name}"
        if not isinstance(node, MapNode) or not node:
            reason = f"an evaluation is the part of a recipe that it changes, not {kind_of(node)}"
            problems.add(origin, option, reason, "write such as `{views: {inputs: 4}}`")
            continue
        for key in [key for key in node if key not in SECTIONS]:
            reason = f"`{key}` would change the trained model"
            fix = f"an evaluation can only set {', '.join(SECTIONS)}"
            problems.add(node.origins[key], f"{option}.{key}", reason, fix)
        found[name] = node
    return found


def _check_names(
    settings: StudySettings, variants: Mapping[str, MapNode], tree: MapNode, problems: Problems
) -> None:
    if settings.reference not in variants:
        reason = f"there is no variant `{settings.reference}`"
        fix = did_you_mean(settings.reference, variants, "variants")
        problems.add(tree.origins["reference"], "reference", reason, fix)
    published = tree.child("published")
    for name in settings.published.keys() - variants.keys():
        fix = did_you_mean(name, variants, "variants")
        reason = f"there is no variant `{name}`"
        problems.add(published.origins[name], f"published.{name}", reason, fix)


def _contrasts(
    settings: StudySettings,
    tree: MapNode,
    variants: Sequence[str],
    evaluations: Sequence[str],
    problems: Problems,
) -> list[Contrast]:
    found = []
    for number, hypothesis in enumerate(settings.hypotheses):
        try:
            found.append(parsed(hypothesis.claim, variants, evaluations))
        except OptionError as error:
            at = tree["hypotheses"].origins[number]
            problems.add(at, f"hypotheses.{number}", error.reason, error.fix)
    return found
