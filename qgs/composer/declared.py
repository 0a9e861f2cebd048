"""What components say of themselves, and whose fault it is when they cannot."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TypeVar

from qgs.composer.decode import Chosen
from qgs.composer.promises import refuse_unkeepable
from qgs.composer.registry import component_failure
from qgs.contracts import Component, ComponentConfig, Fields, Problem, RecipeContext, Supervision

T = TypeVar("T")


def check_declarations(chosen: Chosen, context: RecipeContext) -> list[Problem]:
    """The `problems` of a component whose declarations can all be read.

    Raises PluginError, which names the distribution, for one whose code fails.
    """

    def ask(name: str, question: Callable[[], T]) -> T:
        try:
            return question()
        except Exception as error:
            raise component_failure(chosen.type, name, error, chosen.installed) from error

    component, config = chosen.component, chosen.config
    ask("requires", lambda: dict(component.requires(config)))
    provided = ask("provides", lambda: dict(component.provides(config)))
    refuse_unkeepable(chosen, provided)
    if issubclass(component, Supervision):
        ask("weights", lambda: dict(component(config).weights()))
    return ask("problems", lambda: _listed(component.problems(config, context)))


def offers(component: type[Component], config: ComponentConfig) -> Fields:
    """What `component` would provide by itself with `config`: not what it needs to be given.

    Nothing for options with which the component cannot be asked: a suggestion must be sound.
    """
    try:
        given = component.requires(config)
        return {n: spec for n, spec in component.provides(config).items() if n not in given}
    except Exception:
        return {}


def needs(component: type[Component], config: ComponentConfig) -> Fields | None:
    """What `component` would require with `config`; None where it cannot be asked."""
    try:
        return component.requires(config)
    except Exception:
        return None


def _listed(problems: Iterable[Problem]) -> list[Problem]:
    found = list(problems)
    for problem in found:
        if not isinstance(problem, Problem):
            raise TypeError(f"it gives {type(problem).__name__}, not qgs.contracts.Problem")
    return found
