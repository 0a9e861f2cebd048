"""Options: what a user writes is what the component gets."""

from dataclasses import replace
from typing import Any

from pydantic import BaseModel, ValidationError

from qgs.contracts import ComponentConfig
from qgs.recipe.decode import decode_config, models_in
from qgs.recipe.errors import Problems, RecipeError
from qgs.recipe.yaml_text import dump, load_mapping
from qgs_dev.case import Case, expect
from qgs_dev.checks.objective import rehearsed
from qgs_dev.inputs import inputs_of
from qgs_dev.modules import seeded
from qgs_dev.registry import ALL_SLOTS, MODULES, check
from qgs_dev.trees import difference


@check(ALL_SLOTS, tier="construction")
def check_config_round_trip(case: Case) -> None:
    """Options written as YAML and read again are the same options."""
    options = case.config.model_dump(mode="json")
    lost = sorted(type(case.config).model_fields.keys() - options)
    expect(not lost, f"{', '.join(lost)} is not written")
    again, message = _decoded(case, dump(options))
    expect(again is not None, f"{options} is refused: {message}")
    expect(again == case.config, f"{case.config!r} is read again as {again!r}")


@check(ALL_SLOTS, tier="construction")
def check_misspelt_option_is_refused(case: Case) -> None:
    """An option that does not exist is refused, and the nearest one that does is suggested.

    The same holds for options inside of an option.
    """
    names = list(type(case.config).model_fields)
    wrong = f"{names[0]}_x" if names else "no_such_option"
    config, message = _decoded(case, dump({**case.config.model_dump(mode="json"), wrong: 1}))
    expect(config is None, f"the option `{wrong}` is accepted")
    expect(not names or f"did you mean `{names[0]}`" in message, f"the message is: {message}")
    for model in _nested(type(case.config)):
        strict = model.model_config.get("extra") == "forbid"
        expect(strict, f"{model.__qualname__} accepts any option; derive it from ComponentConfig")


@check(ALL_SLOTS - {"data"}, tier="construction")
def check_options_are_left_alone(case: Case) -> None:
    """Building a component changes nothing in its options."""
    own = replace(case, config=case.config.model_copy(deep=True))
    own.build()
    expect(own.config == case.config, f"when it is built, {case.config!r} becomes {own.config!r}")


@check(MODULES | {"objective"})
def check_scheduled_options_are_read_anew(case: Case) -> None:
    """An option in `scheduled` counts in the next call once it is changed, as if built with it.

    What a component requires and provides does not depend on it.
    """
    for option in sorted(case.component.scheduled):
        config = _with_another(case.config, option)
        other = replace(case, config=config, state_dict=None)
        if config == case.config or other.problems(case.size):
            continue
        value = getattr(config, option)
        for what in (case.component.fields_read, case.component.fields_written):
            same = dict(what(config)) == dict(what(case.config))
            expect(same, f"`{option}: {value}` changes its `{what.__name__}`")
        module = _ready(case)
        _called(case, module)
        module.config = config
        found = difference(_called(case, _ready(other)), _called(case, module))
        expect(not found, f"with `{option}: {value}` set after it was built, {found}")


def _with_another(config: ComponentConfig, option: str) -> ComponentConfig:
    """`config` with half or twice a number, or 0.5 for 0; the same where neither is allowed."""
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


def _decoded(case: Case, text: str) -> tuple[ComponentConfig | None, str]:
    """The options that the composer reads from `text`, and the message if it refuses them."""
    problems = Problems()
    node = load_mapping(text, "case", problems)
    config = decode_config(case.component.Config, node, (), problems)
    try:
        problems.raise_any()
    except RecipeError as error:
        return config, str(error)
    return config, ""
