"""Options: what a user writes is what the component gets."""

from typing import Any

from pydantic import BaseModel, ValidationError

from qgs.contracts import ComponentConfig
from qgs.recipe.decode import decode_config, models_in
from qgs.recipe.errors import Problems, RecipeError
from qgs.recipe.yaml_text import dump, load_mapping
from qgs_dev.case import Case
from qgs_dev.checks.judging import rehearsed
from qgs_dev.inputs import inputs_of
from qgs_dev.modules import seeded
from qgs_dev.vocabulary import expect, expect_none, expect_same


def check_config_round_trip(case: Case) -> None:
    """Options written as YAML and read again are the same options."""
    options = case.config.model_dump(mode="json")
    expect_none(type(case.config).model_fields.keys() - options, "not written")
    again, message = _decoded(case, options)
    expect(again is not None, f"{options} is refused: {message}")
    expect(again == case.config, f"{case.config!r} is read again as {again!r}")


def check_misspelt_option_is_refused(case: Case) -> None:
    """An option that does not exist is refused, and the nearest one that does is suggested.

    The same holds for options inside of an option.
    """
    names = list(type(case.config).model_fields)
    # One letter too many: near enough for a suggestion.
    wrong = f"{names[0]}_x" if names else "no_such_option"
    config, message = _decoded(case, {**case.config.model_dump(mode="json"), wrong: 1})
    expect(config is None, f"the option `{wrong}` is accepted")
    expect(not names or f"did you mean `{names[0]}`" in message, f"the message is: {message}")
    for model in _nested(type(case.config), set()):
        strict = model.model_config.get("extra") == "forbid"
        expect(strict, f"{model.__qualname__} accepts any option; derive it from ComponentConfig")


def check_options_are_left_alone(case: Case) -> None:
    """Building a component changes nothing in its options."""
    # A shallow copy would share lists, and their change would go unseen.
    own = case.with_config(case.config.model_copy(deep=True))
    own.build()
    expect(own.config == case.config, f"when it is built, {case.config!r} becomes {own.config!r}")


def check_scheduled_options_are_read_anew(case: Case) -> None:
    """An option in `scheduled` counts in the next call once it is changed, as if built with it.

    What a component requires and provides does not depend on it.
    """
    for option in sorted(case.component.scheduled):
        other = case.with_config(_with_another(case.config, option))
        if other.config == case.config or other.problems(case.size):
            continue
        what = f"`{option}: {getattr(other.config, option)}`"
        same = dict(other.reads) == dict(case.reads) and dict(other.writes) == dict(case.writes)
        expect(same, f"{what} changes what it requires or provides")
        module = _ready(case)
        # A first call may keep what the second must read anew.
        _called(case, module)
        module.config = other.config
        where = f"with {what} set after it was built"
        expect_same(_called(case, _ready(other)), _called(case, module), where)


def _with_another(config: ComponentConfig, option: str) -> ComponentConfig:
    """Return `config` with half or twice a number, or 0.5 for 0; itself if neither is allowed."""
    value = getattr(config, option)
    for other in (value / 2, 2 * value) if value else (0.5, 1):
        try:
            changed = {**dict(config), option: type(value)(other)}
            return type(config).model_validate(changed)
        except (ValidationError, TypeError):
            continue
    return config


def _ready(case: Case) -> Any:
    return case.build() if case.slot == "objective" else case.lively()


def _called(case: Case, module: Any) -> Any:
    if case.slot == "objective":
        return rehearsed(case, module)
    with seeded(0):
        return module(*inputs_of(case).values())


def _nested(config: type[BaseModel], found: set[type[BaseModel]]) -> set[type[BaseModel]]:
    """Return `found` with the models that options of `config`, or options in these, can hold."""
    for field in config.model_fields.values():
        for model in models_in(field.annotation):
            if model not in found:
                found.add(model)
                _nested(model, found)
    return found


def _decoded(case: Case, options: dict[str, Any]) -> tuple[ComponentConfig | None, str]:
    """The options that the composer reads from YAML, and the message if it refuses them."""
    problems = Problems()
    node = load_mapping(dump(options), "case", problems)
    config = decode_config(case.component.Config, node, (), problems)
    try:
        problems.raise_any()
    except RecipeError as error:
        return config, str(error)
    return config, ""
