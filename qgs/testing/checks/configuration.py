"""Options: what a user writes is what the component gets."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from pydantic import BaseModel, ValidationError

from qgs.composer.decode import decode_config, models_in
from qgs.composer.errors import Problems, RecipeError
from qgs.composer.flow import variants
from qgs.composer.yaml_text import dump, load_mapping
from qgs.contracts import ComponentConfig, Problem
from qgs.testing.case import Case
from qgs.testing.faults import expect
from qgs.testing.registry import ALL_SLOTS, check


@check(ALL_SLOTS)
def check_config_round_trip(case: Case) -> None:
    """Options written as YAML and read again are the same options, with other values too."""
    for config in (case.config, *_neighbours(case.config)):
        text = dump(config.model_dump(mode="json"))
        again, faults = _decoded(case, text)
        expect(again is not None, f"`{text.strip()}` is refused: {faults}")
        expect(again == config, f"{config!r} is read again as {again!r}")


@check(ALL_SLOTS)
def check_misspelt_option_is_refused(case: Case) -> None:
    """An option that does not exist is refused, and the nearest one that does is suggested.

    So it is in options that stand inside of an option.
    """
    names = list(type(case.config).model_fields)
    wrong = f"{names[0]}_x" if names else "no_such_option"
    options = {**case.config.model_dump(mode="json"), wrong: 1}
    config, faults = _decoded(case, dump(options))
    expect(config is None, f"the option `{wrong}` is accepted")
    expect(not names or f"did you mean `{names[0]}`" in faults, f"the message is: {faults}")
    for model in _nested(type(case.config)):
        where = f"the option `no_such_option` of {model.__qualname__}"
        expect(_refuses_others(model), f"{where} is accepted; set extra='forbid' there too")


@check(ALL_SLOTS)
def check_config_is_frozen(case: Case) -> None:
    """Options cannot be changed once they are set."""
    for name in type(case.config).model_fields:
        before = getattr(case.config, name)
        try:
            setattr(case.config, name, before)
        except (ValidationError, AttributeError, TypeError):
            continue
        expect(False, f"`{name}` can be assigned to; derive Config from ComponentConfig")


@check(ALL_SLOTS - {"data"})
def check_options_are_left_alone(case: Case) -> None:
    """Building a component changes nothing in its options."""
    own = replace(case, config=case.config.model_copy(deep=True))
    before = own.config.model_copy(deep=True)
    own.build()
    expect(own.config == before, f"when it is built, {before!r} becomes {own.config!r}")


@check(ALL_SLOTS)
def check_problems_are_told(case: Case) -> None:
    """`problems` gives qgs.contracts.Problem objects that name an option, a reason and a fix."""
    found = case.problems(case.size)
    for problem in found:
        expect(isinstance(problem, Problem), f"`problems` gives {problem!r}")
        option = problem.option.partition(".")[0]
        known = not option or option in type(case.config).model_fields
        expect(known, f"a problem is about the option `{option}`, which does not exist")
        expect(bool(problem.reason and problem.fix), f"{problem} lacks a reason or a fix")
    expect(not found, f"the options of this case are refused: {[p.reason for p in found]}")


@check(ALL_SLOTS)
def check_declarations_depend_on_options_alone(case: Case) -> None:
    """`requires` and `provides` give the same FieldSpecs each time, for equal options."""
    twin = case.config.model_copy(deep=True)
    for name in ("requires", "provides"):
        first, second = (dict(getattr(case.component, name)(c)) for c in (case.config, twin))
        expect(first == second, f"`{name}` gives {first}, then {second}")
        for field, spec in first.items():
            kind = type(spec).__name__
            expect(kind == "FieldSpec", f"`{name}` gives a {kind} for {field}")


def _neighbours(config: ComponentConfig) -> Iterator[ComponentConfig]:
    """`config` with one option otherwise, as far as the options allow."""
    choices = [(option, getattr(other, option)) for option, _, other in variants(config)]
    choices += [
        (option, value)
        for option in type(config).model_fields
        for value in _other_values(getattr(config, option))
    ]
    for option, value in choices:
        try:
            yield type(config).model_validate({**dict(config), option: value})
        except ValidationError:
            continue


def _other_values(value: Any) -> tuple[Any, ...]:
    """Numbers that are not the given one, nor round ones."""
    match value:
        case bool():
            return ()
        case int():
            return (value + 1, value - 1)
        case float():
            return (1.37 * value + 0.0123, 0.61 * value + 0.00321)
        case None:
            return (1.37, 3)
    return ()


def _nested(config: type[BaseModel]) -> set[type[BaseModel]]:
    """The models that options of `config`, or options in these, can hold."""
    found: set[type[BaseModel]] = set()
    left = [config]
    while left:
        fields = left.pop().model_fields.values()
        models = {model for field in fields for model in models_in(field.annotation)} - found
        found |= models
        left += models
    return found


def _refuses_others(model: type[BaseModel]) -> bool:
    try:
        model.model_validate_json('{"no_such_option": 1}')
    except ValidationError as error:
        return any(detail["type"] != "missing" for detail in error.errors())
    return False


def _decoded(case: Case, text: str) -> tuple[ComponentConfig | None, str]:
    problems = Problems()
    node = load_mapping(text, "case", problems)
    config = decode_config(case.component.Config, node, (), problems)
    try:
        problems.raise_any()
    except RecipeError as error:
        return config, str(error)
    return config, ""
