"""Options that no check exercised: other values change nothing of what the checks see."""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any, Literal, get_args, get_origin

from pydantic import ValidationError

from qgs.composer.yaml_text import inline
from qgs.contracts import ComponentConfig
from qgs_plugintools.case import Case
from qgs_plugintools.inputs import Inputs, inputs_of, tracked_inputs
from qgs_plugintools.modules import seeded
from qgs_plugintools.registry import MODULES
from qgs_plugintools.trees import cloned, difference, gradients, scalar


def idle_options(cases: Iterable[Case]) -> dict[str, list[str]]:
    """Options of sound cases of one component to the other values, in YAML, that changed nothing.

    Numbers and choices are tried on inputs of the sizes that most checks use; what changes outputs
    or gradients in one case is exercised. No values for options of other kinds, and for those that
    nothing can be built or run with.
    """
    idle: dict[str, list[str]] = {}
    exercised: set[str] = set()
    for case in (case for case in cases if case.slot in MODULES):
        inputs = inputs_of(case)
        before = [*_results(case, inputs)]
        for option in type(case.config).model_fields:
            idle.setdefault(option, [])
        for option, value, config in (*variants(case.config), *numbers(case.config)):
            other = replace(case, config=config, state_dict=None)
            if option in exercised:
                continue
            try:
                if other.problems(case.size):
                    continue
                after = _results(other, inputs)
                changed = any(difference(*both) for both in zip(before, after, strict=True))
            except Exception:  # a value that cannot be built or run here says nothing
                continue
            if changed:
                exercised.add(option)
            elif value not in idle[option]:
                idle[option].append(value)
    return {option: tried for option, tried in idle.items() if option not in exercised}


def variants(config: ComponentConfig) -> Iterator[tuple[str, str, ComponentConfig]]:
    """`config` with another choice of one option that is a bool or a Literal.

    Yields the option, its new value in YAML, and the new config.
    """
    for option, field in type(config).model_fields.items():
        is_choice = get_origin(field.annotation) is Literal
        choices = get_args(field.annotation) if is_choice else (True, False)
        for choice in choices if is_choice or field.annotation is bool else ():
            if choice != getattr(config, option):
                yield option, inline(choice), config.model_copy(update={option: choice})


def numbers(config: ComponentConfig) -> Iterator[tuple[str, str, ComponentConfig]]:
    """Whole numbers near each one, half and twice every other, 1/2 and 1 for 0.0, where allowed."""
    chosen = {option: getattr(config, option) for option in config.model_fields_set}
    for option, value in dict(config).items():
        if type(value) is int:
            others = (value - 1, value + 1, 2 * value)
        elif type(value) is float:
            others = (value / 2, 2 * value) if value else (0.5, 1.0)
        else:
            continue
        for other in (other for other in others if other != value):
            try:
                yield option, inline(other), type(config).model_validate({**chosen, option: other})
            except ValidationError:
                continue


def _results(case: Case, inputs: Inputs) -> Iterator[Any]:
    """Outputs of one seed in evaluation; then in training, with gradients."""
    module = case.lively()
    with seeded(0):
        yield cloned(module(*inputs.values()))
    given = tracked_inputs(case, inputs)
    with seeded(0):
        outputs = module.train()(*given.values())
    reached = [given, dict(module.named_parameters())]
    yield [cloned(outputs), gradients(scalar(outputs), reached)]
