"""Runner of the contract suite: runs the checks in checks.toml on components of a plugin."""

import inspect
import traceback
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Literal, NamedTuple, get_args

from qgs.contracts import Component, ComponentConfig, MissingExtraError, ModelComponent
from qgs.recipe.registry import InstalledPlugin, PluginError, default_config, load_plugin
from qgs.recipe.slots import SLOTS, summary_of
from qgs.wording import did_you_mean
from qgs_dev.case import CannotCheck, Case, ContractError
from qgs_dev.inputs import FACTS, data_file

Tier = Literal["core", "construction", "extended"]
TIERS: tuple[Tier, ...] = get_args(Tier)

# Checks that no plugin may expect to fail: without them the other checks mean nothing.
BASICS = ("builds", "runs")

# Checks that run first: when they fail, checks that compare two forward passes fail too.
FIRST = (*BASICS, "forward_keeps_no_state", "eval_repeats_bitwise")


class Check(NamedTuple):
    """One check of the contract.

    variants: True if the check runs on every case of a component, False if on the first case only.
    """

    name: str
    function: Callable[[Case], None]
    slots: Collection[str]
    tier: Tier
    variants: bool

    @property
    def contract(self) -> str:
        """Requirement as one sentence: the first paragraph of the check function's docstring."""
        return summary_of(self.function)


def _listed() -> Iterator[Check]:
    """Yield the checks in checks.toml. Check NAME is the function `check_NAME(case)`."""
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
    """Return the checks for the slot of `case`. Checks whose failure makes others fail come first.

    variant: True if the component has had an earlier case; checks that run on the first case only
    are then left out.
    """
    wanted = {*tiers}
    # Otherwise a run without checks would pass.
    assert wanted, "no tiers"
    assert wanted <= {*TIERS}, f"tiers are {wanted}, not some of {TIERS}"
    found = [
        check
        for check in CHECKS.values()
        if case.slot in check.slots and check.tier in wanted and (check.variants or not variant)
    ]
    # False sorts before True.
    return sorted(found, key=lambda check: [check.name != name for name in FIRST])


Verdict = Literal["passed", "failed", "skipped", "expected failure", "unexpected pass"]


@dataclass(frozen=True)
class CheckResult:
    """Result of one check on one case.

    message: reason why the verdict is not "passed"; "" if it is.
    """

    case: Case
    check: Check
    verdict: Verdict
    message: str = ""

    @property
    def ok(self) -> bool:
        """True unless the check failed, or passed although a failure was expected."""
        return self.verdict not in ("failed", "unexpected pass")

    @property
    def leaves_unchecked(self) -> bool:
        """True if the component could not be built or called on this machine."""
        return self.verdict == "skipped" and self.check.name in BASICS


@dataclass
class CaseRun:
    """Run of all checks on one case. If `builds` or `runs` fails, the other checks are skipped.

    expected: reason for each expected failure, by name of the check. If a check with a reason
    passes, it counts as failed. variant: True if an earlier case had the same component; then a
    check runs only if its `variants` is True.
    """

    case: Case
    expected: Mapping[str, str] = field(default_factory=dict)
    variant: bool = False

    def __str__(self) -> str:
        return self.case.label

    def results(self, tiers: Iterable[Tier] = TIERS) -> Iterator[CheckResult]:
        """Run the checks in order, and yield the result of each."""
        cause = ""
        for check in checks_for(self.case, tiers, self.variant):
            if cause:
                yield CheckResult(self.case, check, "skipped", f"`{cause}` fails: see that check")
                continue
            result = run_check(check, self.case, self.expected.get(check.name, ""))
            # One cause is one failure: what cannot run fails every other check.
            if check.name in BASICS and not result.ok:
                cause = check.name
            yield result

    def check(self, tiers: Iterable[Tier] = TIERS) -> None:
        """Run all checks inside a pytest test. The test fails with the messages of failed checks.

        The test is skipped if the component cannot be built or called on this machine. tiers:
        groups of checks to run, from TIERS.
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
    """Run `check` on `case`.

    expected: reason why the check should fail; if it is given, a pass counts as a failure.
    """
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
    fix = "remove the expected failure, or restrict it to the options with which it fails"
    why = f"{title} passes, although it is expected to fail: {expected}\n  fix: {fix}"
    return CheckResult(case, check, "unexpected pass", why)


def refuse_unexpectable(expected: Mapping[str, str], runs: Iterable[CaseRun]) -> None:
    """Raise ValueError for an expected failure that has no reason or is not allowed.

    An expected failure is allowed for checks that `runs` include, except for the two checks
    "builds" and "runs", which all others need. expected: reason for each failure, by check name.
    """
    made = {check.name for run in runs for check in checks_for(run.case, variant=run.variant)}
    for name, why in expected.items():
        if name not in made.difference(BASICS):
            fix = did_you_mean(str(name), made, "checks that run on it")
            raise ValueError(
                f"the check `{name}` cannot be an expected failure, because it does not run on "
                f"this component with these options, or because other checks need it; {fix}"
            )
        if not (isinstance(why, str) and why.strip()):
            raise ValueError(f"the expected failure of `{name}` has no reason: give one as text")


def with_place(error: BaseException, component: type) -> str:
    """Return type and message of `error`, and FILE:LINE in the component's package if known.

    FILE:LINE is the innermost line of the traceback in the package. It is left out for a
    ContractError, and if no line of the traceback is in the package.
    """
    # Notes say at which point of a check the error happened.
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


# Decoder depths to try in turn until the component's `problems` accepts one.
DEPTHS = (2, 12)


def cases_of(installed: InstalledPlugin) -> list[Case]:
    """Return a case for the default options of each component, and for each example of the plugin.

    Raises PluginError for an example that is not a Config of a component of the plugin.
    """
    plugin = installed.plugin
    for example in plugin.examples:
        if getattr(type(example), "__component__", None) not in plugin.components:
            fault = f"{example!r} is not a Config of its components; give MyComponent.Config()"
            raise _unsound(installed, "examples", fault)
    configs = [*filter(None, map(default_config, plugin.components))]
    configs += [example for example in plugin.examples if example not in configs]
    return [_case(config) for config in configs]


def without_case(installed: InstalledPlugin) -> list[type[Component]]:
    """Return components with no case: they have no example and no valid default options."""
    checked = {case.component for case in cases_of(installed)}
    return [component for component in installed.plugin.components if component not in checked]


def runs_of(plugin: str | InstalledPlugin) -> list[CaseRun]:
    """Return a CaseRun for each case of a plugin, as parameters of a pytest test.

        @pytest.mark.parametrize("run", runs_of("sightline"), ids=str)
        def test_contract(run):
            run.check()

    The first case of a component runs all checks, later cases run only checks with `variants`.
    Raises PluginError if the plugin cannot be loaded, or has invalid examples or expected failures.
    """
    installed = load_plugin(plugin) if isinstance(plugin, str) else plugin
    runs: list[CaseRun] = []
    for case in cases_of(installed):
        # Later cases of a class need only the checks that depend on options.
        variant = any(run.case.component is case.component for run in runs)
        runs.append(CaseRun(case, variant=variant))
    for owner, exempted in installed.plugin.exemptions.items():
        concerned = [run for run in runs if owner in (run.case.component, run.case.config)]
        if not concerned:
            fault = f"{owner!r} is neither a component of the plugin nor the Config of a case"
            raise _unsound(installed, "exemptions", fault)
        try:
            refuse_unexpectable(exempted, concerned)
        except (ValueError, AttributeError) as error:
            raise _unsound(installed, "exemptions", f"entry {owner!r}: {error}") from error
        for run in concerned:
            run.expected = {**run.expected, **exempted}
    return runs


def check_plugin(name: str, tiers: Iterable[Tier]) -> Iterator[CheckResult]:
    """Run all checks on each case of the plugin `name`, and yield the results case by case.

    Raises PluginError if the plugin cannot be loaded, or has invalid examples or expected failures.
    """
    runs = runs_of(name)
    return (result for run in runs for result in run.results(tiers))


def _case(config: ComponentConfig) -> Case:
    """Return a case with as few decoder layers as the options allow."""
    cases = [Case(config).with_dims(depth=depth) for depth in DEPTHS]
    return next((case for case in cases if _accepts(case)), cases[0])


def _accepts(case: Case) -> bool:
    """Return True if `problems` finds no fault with the options of `case`.

    Return False if `problems` raises an error, which the checks then report.
    """
    try:
        return not case.problems()
    except (Exception, SystemExit):
        return False


def _unsound(installed: InstalledPlugin, what: str, fault: str) -> PluginError:
    return PluginError(
        f"the `{what}` of the plugin `{installed.plugin.name}` of {installed.released_as}: {fault}",
        f"correct the `{what}` of its Plugin",
    )
