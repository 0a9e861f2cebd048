"""The contract suite: its checks, as checks.toml lists them, made of the components of a plugin."""

import inspect
import traceback
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from inspect import cleandoc
from pathlib import Path
from typing import Literal, TypeAlias, get_args

from qgs.contracts import Component, ComponentConfig, ModelComponent, ModelDims
from qgs.contracts.component import MissingExtraError
from qgs.recipe.registry import InstalledPlugin, PluginError, default_config, load_plugin
from qgs.recipe.slots import SLOTS
from qgs.wording import did_you_mean
from qgs_dev.case import SMALL, CannotCheck, Case, ContractError
from qgs_dev.inputs import FACTS, data_file

Tier: TypeAlias = Literal["core", "construction", "extended"]
TIERS: tuple[Tier, ...] = get_args(Tier)

# Checks that cannot be expected to fail: without them the others say nothing.
BASICS = ("builds", "runs")

# Checks that come first: when they fail, others do too, which compare two forward passes.
FIRST = (*BASICS, "forward_keeps_no_state", "eval_repeats_bitwise")


@dataclass(frozen=True)
class Check:
    """One promise of the contract.

    variants: whether it is checked of every case of a class; the others are checked of the first
    case alone.
    """

    name: str
    function: Callable[[Case], None]
    slots: Collection[str]
    tier: Tier
    variants: bool

    @property
    def contract(self) -> str:
        """The promise in one sentence: the first paragraph of the function's docstring."""
        return " ".join(cleandoc(self.function.__doc__ or "").split("\n\n")[0].split())


def _listed() -> Iterator[Check]:
    """The checks of checks.toml: `check_NAME(case)` of the module of its subject is NAME."""
    subjects = data_file("checks.toml")
    groups = subjects.pop("groups")
    groups["all"] = [*SLOTS]
    groups["modules"] = [*FACTS]
    groups["parametric"] = [n for n in FACTS if issubclass(SLOTS[n].contract, ModelComponent)]
    for subject, rows in subjects.items():
        module = import_module(f"qgs_dev.checks.{subject}")
        for name, row in rows.items():
            slots = {slot for group in row["slots"] for slot in groups.get(group, [group])}
            yield Check(
                name=name,
                function=getattr(module, f"check_{name}"),
                slots=slots.difference(row.get("but", ())),
                tier=row.get("tier", "core"),
                variants=row.get("variants", False),
            )


CHECKS = {check.name: check for check in _listed()}


def checks_for(case: Case, tiers: Iterable[Tier] = TIERS, variant: bool = False) -> list[Check]:
    """The checks that apply to the slot of `case`, causes before what they cause.

    variant: whether another case of its class comes before it; then only those of `variants`.
    """
    wanted = {*tiers}
    # No check at all would pass.
    assert wanted, "no tiers"
    assert wanted <= {*TIERS}, f"tiers are {wanted}, not some of {TIERS}"
    found = [
        check
        for check in CHECKS.values()
        if case.slot in check.slots and check.tier in wanted and (check.variants or not variant)
    ]
    # False sorts before True.
    return sorted(found, key=lambda check: [check.name != name for name in FIRST])


Verdict: TypeAlias = Literal["passed", "failed", "skipped", "expected failure", "unexpected pass"]


@dataclass(frozen=True)
class CheckResult:
    """How a check of a case went. message: why it did not simply pass."""

    case: Case
    check: Check
    verdict: Verdict
    message: str = ""

    @property
    def ok(self) -> bool:
        """True if nothing is to be mended."""
        return self.verdict not in ("failed", "unexpected pass")

    @property
    def leaves_unchecked(self) -> bool:
        """True if the component could not be built or called here."""
        return self.verdict == "skipped" and self.check.name in BASICS


@dataclass
class CaseRun:
    """All checks of one case. After `builds` or `runs` fails, the rest is skipped.

    expected: check -> why it fails; such a check that passes is a failure.
    variant: whether another case of its class comes before it; see `Check.variants`.
    """

    case: Case
    expected: Mapping[str, str] = field(default_factory=dict)
    variant: bool = False

    def __str__(self) -> str:
        return self.case.label

    def results(self, tiers: Iterable[Tier] = TIERS) -> Iterator[CheckResult]:
        """How each check went, in their order."""
        cause = ""
        for check in checks_for(self.case, tiers, self.variant):
            if cause:
                message = f"`{cause}` fails: see that check"
                yield CheckResult(self.case, check, "skipped", message)
                continue
            result = run_check(check, self.case, self.expected.get(check.name, ""))
            # One cause is one failure: what cannot run fails every other check.
            if check.name in BASICS and not result.ok:
                cause = check.name
            yield result

    def check(self, tiers: Iterable[Tier] = TIERS) -> None:
        """Make all checks inside of a pytest test, which fails with the messages of all that fail.

        It is skipped where the component cannot be built or called. tiers: some of TIERS.
        """
        import pytest

        results = list(self.results(tiers))
        failures = [result.message for result in results if not result.ok]
        if failures:
            pytest.fail("\n\n".join(failures), pytrace=False)
        for result in results:
            if result.leaves_unchecked:
                pytest.skip(result.message)


def run_check(check: Check, case: Case, expected: str = "") -> CheckResult:
    """Run `check` on `case`. expected: why it is known to fail; then passing is a fault."""
    assert case.slot in check.slots, f"`{check.name}` is not for {case.label}"
    title = f"{case.label}: {check.name}"
    try:
        check.function(case)
    except (CannotCheck, MissingExtraError) as error:
        return CheckResult(case, check, "skipped", str(error))
    # SystemExit: a component that ends the process would end the suite.
    except (Exception, SystemExit) as error:
        seen = with_place(error, case.component)
        if expected:
            return CheckResult(case, check, "expected failure", f"{expected} (seen: {seen})")
        message = f"{title}\n  seen: {seen}\n  contract: {check.contract}"
        return CheckResult(case, check, "failed", message)
    if not expected:
        return CheckResult(case, check, "passed")
    fix = "drop the expected failure, or restrict it to the options with which it fails"
    why = f"{title} passes, although it is expected to fail: {expected}\n  fix: {fix}"
    return CheckResult(case, check, "unexpected pass", why)


def refuse_unexpectable(expected: Mapping[str, str], runs: Iterable[CaseRun]) -> None:
    """Raise ValueError for an expected failure of no check, of no run, or without a reason.

    expected: name of a check -> why it fails.
    """
    made = {check.name for run in runs for check in checks_for(run.case, variant=run.variant)}
    for name, why in expected.items():
        if name not in made.difference(BASICS):
            fix = did_you_mean(str(name), made, "checks made of it")
            raise ValueError(f"`{name}` cannot be expected to fail here; {fix}")
        if not (isinstance(why, str) and why.strip()):
            raise ValueError(f"the expected failure of `{name}` needs a reason, as a text")


def with_place(error: BaseException, component: type) -> str:
    """Type and message of `error`, and FILE:LINE of the component's package that raised it.

    A broken contract has no place, nor does what was raised elsewhere.
    """
    # Notes say where in a check it happened.
    noted = "".join(f"{note}, " for note in getattr(error, "__notes__", ()))
    if isinstance(error, ContractError):
        return f"{noted}{error}"
    what = f"{noted}{type(error).__name__}"
    what = f"{what}: {error}" if str(error) else what
    package = Path(inspect.getfile(component)).parent
    # The innermost place in the package, not where torch or the suite raised it.
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        if Path(frame.filename).is_relative_to(package):
            return f"{what} (raised under {frame.filename}:{frame.lineno})"
    return what


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


def without_case(installed: InstalledPlugin) -> list[type[Component]]:
    """Components that have no example and no usable default options."""
    checked = {case.component for case in cases_of(installed)}
    return [component for component in installed.plugin.components if component not in checked]


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


def _unsound(installed: InstalledPlugin, what: str, fault: str) -> PluginError:
    return PluginError(
        f"the `{what}` of the plugin `{installed.plugin.name}` of {installed.released_as}: {fault}",
        f"correct the `{what}` of its Plugin",
    )
