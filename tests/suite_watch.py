"""What the fast suite costs: CPU time by test, and the limits that a whole run must keep.

Every process counts its own tests; under pytest-xdist the controller sums them up. The time that
numba takes to compile a kernel for the first time belongs to no test.
"""

import gc
import os
import time
from operator import itemgetter

import pytest

MAX_ITEMS = 2_400
MAX_SHARE = 1 / 20
"""Of the CPU time of the whole suite, for one test."""
DEAREST = 10


def cpu_seconds():
    """Of this process and of the children that it has waited for."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


class SuiteWatch:
    """Hooks of pytest that print what a whole run cost, and fail it beyond the limits."""

    def __init__(self, config):
        self.config = config
        self.seconds = {}
        self.workers = 0.0
        controls = config.getoption("dist", "no") != "no" and not hasattr(config, "workerinput")
        self.compiling = (lambda: 0.0) if controls else compilation_clock()

    def spent(self):
        """CPU seconds of this process and its children, but for what numba compiled."""
        return cpu_seconds() - self.compiling()

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_protocol(self, item):
        """Count the CPU time of a test with its fixtures."""
        before = self.spent()
        result = yield
        self.seconds[item.nodeid] = self.spent() - before
        return result

    def pytest_collection_finish(self):
        """Leave what was imported to itself: walking through it took a tenth of the time."""
        gc.collect()
        gc.freeze()
        gc.set_threshold(100_000, 20, 20)

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node):
        """Take over what a worker has counted."""
        seconds, whole = node.workeroutput.get("cost", ({}, 0.0))
        self.seconds |= seconds
        self.workers += whole

    @pytest.hookimpl(trylast=True)
    def pytest_sessionfinish(self, session):
        """Hand over what this worker has counted, or judge the whole run."""
        if hasattr(self.config, "workeroutput"):
            self.config.workeroutput["cost"] = (self.seconds, self.spent())
        elif self.faults() and session.exitstatus == pytest.ExitCode.OK:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter):
        """Print the cost, the dearest tests and the faults."""
        if hasattr(self.config, "workeroutput") or not self.seconds:
            return
        minutes = self.whole() / 60
        terminalreporter.section(f"cost: {minutes:.1f} CPU minutes, {len(self.seconds)} items")
        for name, seconds in sorted(self.seconds.items(), key=itemgetter(1), reverse=True)[
            :DEAREST
        ]:
            terminalreporter.write_line(f"{seconds:6.2f} s  {name}")
        for fault in self.faults():
            terminalreporter.write_line(f"FAILED: {fault}", red=True)

    def whole(self):
        """CPU seconds of all processes, collection included."""
        if self.workers:  # they are children of this process
            own = os.times()
            return own.user + own.system + self.workers
        return self.spent()

    def faults(self):
        """What the whole fast suite does not keep; a run of some tests may cost what it will."""
        if not is_whole(self.config):
            return []
        limit = MAX_SHARE * self.whole()
        count = len(self.seconds)
        found = [
            f"{name} takes {seconds:.1f} CPU seconds, more than a twentieth of all: "
            "make it smaller, share what it makes, or mark it slow"
            for name, seconds in self.seconds.items()
            if seconds > limit
        ]
        if count > MAX_ITEMS:
            found.append(f"{count} items are more than {MAX_ITEMS}: make tables of what repeats")
        return found


def is_whole(config):
    """Whether all fast tests of the repository were asked for."""
    chosen = config.option.keyword or config.getoption("lf", False)
    fast = config.option.markexpr == "not slow"
    return fast and not chosen and config.args_source == pytest.Config.ArgsSource.TESTPATHS


def compilation_clock():
    """A function that gives the seconds that numba has compiled for in this process."""
    try:
        from numba.core import event
    except ImportError:
        return lambda: 0.0
    spent = [0.0]
    started = []

    class Compilation(event.Listener):
        """Counts the outermost of compilations that wait for each other."""

        def on_start(self, event):
            started.append(time.process_time())

        def on_end(self, event):
            began = started.pop()
            if not started:
                spent[0] += time.process_time() - began

    event.register("numba:compile", Compilation())
    return lambda: spent[0]
