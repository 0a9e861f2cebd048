"""What tests cost in CPU time, with their fixtures and processes, and what the fast suite may."""

import os
from heapq import nlargest

import pytest
from numba.core import event

MAX_ITEMS = 2_400
MAX_SHARE = 1 / 20
"""Of the CPU time of the whole suite, for one test."""
SECONDS = {}
"""By test; under pytest-xdist the controller has those of all workers."""

# What numba compiles for the first time belongs to no test.
COMPILING = event.TimingListener()
event.register("numba:compile", COMPILING)


def pytest_runtest_protocol(item):
    """Note the clock before a test and after each of its phases, for its last report."""
    compiling = COMPILING.duration if COMPILING.done else 0
    item.user_properties.append(("cpu", sum(os.times()[:4]) - compiling))


pytest_runtest_makereport = pytest_runtest_protocol


def pytest_runtest_logreport(report):
    """Subtract the first of the noted times from the last."""
    if report.when == "teardown":
        (_, begun), *_, (_, ended) = report.user_properties
        SECONDS[report.nodeid] = ended - begun


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_sessionfinish(session):
    """When all workers have ended, print the cost; fail a whole run beyond the limits."""
    yield
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if not reporter or not SECONDS:
        return
    whole = sum(os.times()[:4])
    reporter.section(f"cost: {whole / 60:.1f} CPU minutes, {len(SECONDS)} items")
    for name in nlargest(10, SECONDS, SECONDS.__getitem__):
        reporter.write_line(f"{SECONDS[name]:6.2f} s  {name}")
    for fault in faults(SECONDS, whole) if is_whole(session.config) else ():
        reporter.write_line(f"FAILED: {fault}", red=True)
        session.exitstatus = session.exitstatus or pytest.ExitCode.TESTS_FAILED


def is_whole(config):
    """Whether all fast tests were asked for: a run of some may cost what it will."""
    chosen = config.option.keyword or config.getoption("lf", False)
    fast = config.option.markexpr == "not slow"
    return fast and not chosen and config.args_source == pytest.Config.ArgsSource.TESTPATHS


def faults(seconds, whole):
    """What a whole run of `whole` CPU seconds does not keep."""
    limit = MAX_SHARE * whole
    found = [
        f"{name} takes {spent:.1f} CPU seconds, more than a twentieth of all: make it smaller, "
        "share what it makes, or mark it slow"
        for name, spent in seconds.items()
        if spent > limit
    ]
    if len(seconds) > MAX_ITEMS:
        found.append(f"{len(seconds)} items are more than {MAX_ITEMS}: make tables of what repeats")
    return found
