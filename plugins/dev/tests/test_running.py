"""How checks are run and reported: causes, places of errors, expected failures, arguments."""

import subprocess
import sys
from collections import deque
from importlib import import_module
from itertools import count
from pathlib import Path

import numpy
import pytest
import torch
from contract_mutants import modules
from contract_mutants.modules import CachesByShape, RaisesWhenBuilt
from qgs_dev import (
    CHECKS,
    Case,
    CaseRun,
    checks_for,
    run_check,
)
from qgs_dev.modules import attributes
from torch import nn

from qgs.renderers import GsplatRenderer
from qgs.tokengs import MlpFeedForward

CASE = Case(MlpFeedForward.Config())
CACHES = Case(CachesByShape.Config())
STATE = "forward_keeps_no_state"
FROZEN = "construction"


def test_an_error_is_reported_with_its_place_in_the_component() -> None:
    file = Path(modules.__file__)
    culprit = "raise RuntimeError"
    line = 1 + [culprit in text for text in file.read_text().splitlines()].index(True)
    result = run_check(CHECKS["builds"], Case(RaisesWhenBuilt.Config()))
    assert f" (raised under {file}:{line})\n" in result.message


def test_a_test_of_a_case_names_all_that_fails_and_skips_what_cannot_run(monkeypatch) -> None:
    run = CaseRun(CACHES, expected={FROZEN: "it might"})
    with pytest.raises(pytest.fail.Exception) as failure:
        run.check(["core", "construction"])
    titles = [line for line in str(failure.value).splitlines() if line.startswith(CACHES.label)]
    assert titles[0] == f"{CACHES.label}: {STATE}"
    assert titles[1].startswith(f"{CACHES.label}: {FROZEN} passes, although")
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(pytest.skip.Exception, match="runs on cuda alone"):
        CaseRun(Case(GsplatRenderer.Config())).check(["core"])


def test_further_options_of_a_class_have_the_checks_that_see_options() -> None:
    variant = {check.name for check in checks_for(CASE, variant=True)}
    assert {"builds", "runs", "gradients_match_differences"} <= variant
    assert variant < {check.name for check in checks_for(CASE)}


def test_every_check_is_in_the_table() -> None:
    modules = {import_module(check.function.__module__) for check in CHECKS.values()}
    written = {name for module in modules for name in vars(module) if name.startswith("check_")}
    assert written == {f"check_{name}" for name in CHECKS}


def test_commands_load_no_torch() -> None:
    heavy = "{'torch', 'numpy', 'pydantic'} & {*sys.modules}"
    code = f"import sys, qgs_dev.check_command, qgs_dev.new_command; sys.exit(str({heavy} or ''))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stderr.strip() == ""


class Keeper(nn.Module):
    def __init__(self, kept: object) -> None:
        super().__init__()
        self.part = nn.Linear(2, 2)
        vars(self.part)["_kept"] = kept


KEPT = {
    "a list that grows": ([], lambda kept: kept.append(0)),
    "a queue of constant length": (deque([1, 2], maxlen=2), lambda kept: kept.append(3)),
    "a tensor": (torch.zeros(1000), lambda kept: kept[500:501].add_(1)),
    "an array": (numpy.zeros(1000), lambda kept: kept.__setitem__(500, 1)),
    "an iterator": (count(), next),
}


@pytest.mark.parametrize("what", KEPT)
def test_a_change_is_seen(what: str) -> None:
    kept, change = KEPT[what]
    module = Keeper(kept)
    before = attributes(module)
    assert attributes(module) == before
    change(kept)
    assert [name for name, value in attributes(module).items() if before.get(name) != value]


def test_what_contains_itself_comes_to_an_end() -> None:
    circle: list[object] = []
    circle.append(circle)
    assert attributes(Keeper(circle))["part._kept"] == [None]
