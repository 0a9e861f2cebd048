"""Commands of other distributions: listed with their help, and told apart when they fail."""

from functools import partial
from importlib.metadata import entry_points

import pytest
from commands import done, run_qgs
from tables import must_refuse, rows

from qgs.cli import COMMANDS, GROUP

APP = """
import typer
plugin = typer.Typer()

@plugin.command()
def first(number: int) -> None:
    print("twice", 2 * number)

@plugin.command()
def second() -> None:
    pass
"""


@pytest.fixture
def offer(install):
    """`offer("colours", "paint", code)`: installs a distribution with that command."""
    return partial(install, version="2.1", group=GROUP)


def test_it_is_listed_with_its_help_and_called(offer):
    offer("colours", "paint", APP.replace("Typer()", "Typer(help='Paint a scene.')"))
    assert "Paint a scene." in run_qgs("--help").output
    assert run_qgs("paint first 21").output == "twice 42\n"
    assert "second" in run_qgs("paint --help").output


BROKEN = """
import no_such_package | ModuleNotFoundError: No module named
plugin = 3 | not a typer.Typer; update it
raise SystemExit('no display') | SystemExit: no display; update it
"""
"""A module, and what is told of it."""


@pytest.mark.parametrize(("code", "reason"), rows(BROKEN))
def test_one_that_cannot_be_used_is_told_and_the_others_work(offer, code, reason):
    offer("colours", "paint", code)
    error = must_refuse(r"the command `qgs paint` of colours 2\.1", done, "paint first")
    assert reason in str(error)
    done("--help")


def test_of_two_with_one_name_neither_runs_and_our_own_are_never_hidden(offer):
    offer("colours", "paint", APP)
    offer("more-colours", "paint", APP)
    must_refuse(r"`qgs paint` of colours 2\.1, more-colours 2\.1", done, "paint first 1")
    offer("trains", "train", "raise RuntimeError")
    assert "Recipe file" in run_qgs("train --help").output
    assert "trains" not in run_qgs("--help").output


def test_a_command_that_is_not_there_says_what_to_install():
    must_refuse(r"qgs paint.*query-gaussians\[all\]", done, "paint")
    assert {entry.name for entry in entry_points(group=GROUP)}.isdisjoint(COMMANDS)
