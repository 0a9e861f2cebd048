"""The contract suite on all components of an installed plugin."""

from collections.abc import Iterable, Iterator

from qgs.contracts import Component, ComponentConfig, ModelDims
from qgs.recipe.registry import InstalledPlugin, PluginError, default_config, load_plugin
from qgs_dev.case import SMALL, Case
from qgs_dev.registry import TIERS, Tier
from qgs_dev.running import CaseRun, CheckResult, refuse_unexpectable, with_place

# Decoder depths that are tried in turn until the component's `problems` accepts one.
DEPTHS = (2, 12)


def cases_of(installed: InstalledPlugin) -> list[Case]:
    """Every component of the plugin with its default options, and the plugin's examples.

    Raises PluginError for `examples` that are not options of its components.
    """
    plugin = installed.plugin
    for example in plugin.examples:
        if getattr(type(example), "__component__", None) not in plugin.components:
            fault = f"{example!r} is not options of its components, such as MyComponent.Config()"
            raise _unsound(installed, "examples", fault)
    defaults = [default_config(component) for component in plugin.components]
    configs = [config for config in defaults if config is not None]
    configs += [example for example in plugin.examples if example not in configs]
    return [_case(config) for config in configs]


def without_case(installed: InstalledPlugin) -> dict[type[Component], str]:
    """Components that have no example and no usable default options, and why."""
    checked = {case.component for case in cases_of(installed)}
    return {c: _why_no_default(c) for c in installed.plugin.components if c not in checked}


def runs_of(plugin: str | InstalledPlugin) -> list[CaseRun]:
    """Return a run for each case of a plugin, for pytest to make a test of each.

        @pytest.mark.parametrize("run", runs_of("sightline"), ids=str)
        def test_contract(run):
            run.check()

    The first case of a class has all checks, the others those of `variants`. Raises PluginError for
    a plugin that is unusable, and for examples or exemptions that no check can have.
    """
    installed = load_plugin(plugin) if isinstance(plugin, str) else plugin
    runs: list[CaseRun] = []
    for case in cases_of(installed):
        # The first case of a class has all checks, so the others need only those that see options.
        variant = any(run.case.component is case.component for run in runs)
        runs.append(CaseRun(case, variant=variant))
    for owner, exempted in installed.plugin.exemptions.items():
        concerned = [run for run in runs if owner in (run.case.component, run.case.config)]
        if not concerned:
            fault = f"{owner!r} is neither a component of the plugin nor the options of a case"
            raise _unsound(installed, "exemptions", fault)
        try:
            refuse_unexpectable(exempted, concerned)
        except (ValueError, AttributeError) as error:
            raise _unsound(installed, "exemptions", f"those of {owner!r}: {error}") from error
        for run in concerned:
            run.expected = {**run.expected, **exempted}
    return runs


def check_plugin(name: str, tiers: Iterable[Tier] = TIERS) -> Iterator[CheckResult]:
    """Run every check on every case of the plugin `name`, case by case.

    Raises PluginError for a plugin that is unusable or has invalid examples or exemptions.
    """
    runs = runs_of(name)
    return (result for run in runs for result in run.results(tiers))


def _case(config: ComponentConfig) -> Case:
    """A case with as few decoder layers as the options allow."""
    cases = [Case(config, ModelDims(SMALL.width, SMALL.heads, depth)) for depth in DEPTHS]
    return next((case for case in cases if _accepts(case)), cases[0])


def _accepts(case: Case) -> bool:
    """Return whether `problems` finds none; if it raises, the checks of the case report that."""
    try:
        return not case.problems(case.size)
    except (Exception, SystemExit):
        return False


def _why_no_default(component: type[Component]) -> str:
    options = component.Config.model_fields.items()
    required = [f"`{name}`" for name, option in options if option.is_required()]
    if required:
        return f"there is no default for {', '.join(required)}"
    try:
        component.Config()
    except (Exception, SystemExit) as error:
        return f"its default options are refused: {with_place(error, component)}"
    raise AssertionError("a component with default options has a case")


def _unsound(installed: InstalledPlugin, what: str, fault: str) -> PluginError:
    return PluginError(
        f"the `{what}` of the plugin `{installed.plugin.name}` of {installed.released_as}: {fault}",
        f"correct the `{what}` of its Plugin",
    )
