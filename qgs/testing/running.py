"""Making one check of one case, and telling how it went."""

from __future__ import annotations

import traceback
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

from qgs.composer.suggest import did_you_mean
from qgs.contracts.extras import MissingExtraError
from qgs.testing.case import Case
from qgs.testing.faults import CannotCheck, ContractError
from qgs.testing.registry import CHECKS, Check

Verdict: TypeAlias = Literal["passed", "failed", "skipped", "expected failure", "unexpected pass"]


@dataclass(frozen=True)
class Outcome:
    """How a check of a case went. message: why it did not simply pass."""

    case: Case
    check: Check
    verdict: Verdict
    message: str = ""

    @property
    def ok(self) -> bool:
        """Whether nothing is to be mended."""
        return self.verdict not in ("failed", "unexpected pass")


def run_check(check: Check, case: Case, expected: str | None = None) -> Outcome:
    """Make `check` of `case`. expected: why it is known to fail; then a pass is a fault."""
    try:
        check.function(case)
    except (CannotCheck, MissingExtraError) as error:
        return Outcome(case, check, "skipped", str(error))
    except Exception as error:
        if expected is not None:
            return Outcome(case, check, "expected failure", expected)
        return Outcome(case, check, "failed", _told(check, case, error))
    if expected is None:
        return Outcome(case, check, "passed")
    why = f"{case.label}: {check.name} passes, although it is expected to fail: {expected}"
    return Outcome(case, check, "unexpected pass", f"{why}\n  fix: drop the expected failure")


def refuse_unknown(names: Mapping[str, str], cases: list[Case]) -> None:
    """Raise ValueError for an expected failure that no check of `cases` can be."""
    for name, reason in names.items():
        if name not in CHECKS:
            raise ValueError(f"there is no check `{name}`; {did_you_mean(name, CHECKS, 'checks')}")
        if not any(case.slot in CHECKS[name].slots for case in cases):
            slots = ", ".join(sorted(CHECKS[name].slots))
            raise ValueError(f"the check `{name}` applies to none of the cases, but to {slots}")
        if not reason.strip():
            raise ValueError(f"the expected failure of `{name}` needs a reason")


def _told(check: Check, case: Case, error: Exception) -> str:
    seen = error.seen if isinstance(error, ContractError) else _raised(error)
    return f"{case.label}: {check.name}\n  seen: {seen}\n  contract: {check.contract}"


def _raised(error: Exception) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    own = Path(__file__).parent
    places = [frame for frame in frames if own not in Path(frame.filename).parents]
    place = places[0] if places else frames[-1]
    return f"{type(error).__name__}: {error} (raised under {place.filename}:{place.lineno})"
