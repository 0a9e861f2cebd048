"""Commands of other distributions: listed without an import, and told apart when they fail."""

import re
import sys
from collections.abc import Callable
from importlib.metadata import entry_points

import pytest
import typer
from commands import run_qgs

from qgs import DISTRIBUTIONS
from qgs.cli import COMMANDS, GROUP, HELP

Offer = Callable[..., None]
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
def offer(install: Callable[..., None]) -> Offer:
    """`offer("name", code, distribution="d")`: installs a distribution with that command."""

    def offer(name: str, code: str = APP, distribution: str = "colours") -> None:
        install(distribution, name, code, version="2.1", group=GROUP)

    return offer


def test_our_own_commands_are_listed_by_what_they_do() -> None:
    """In the words of the commands themselves, which are not imported for it."""
    assert HELP.keys() == DISTRIBUTIONS[GROUP].keys()
    listed = " ".join(re.sub(r"[^\w\s.:,-]", " ", run_qgs("--help").output).split())
    for entry in entry_points(group=GROUP):
        if entry.name in HELP:
            told = " ".join(re.sub(r"[^\w\s.:,-]", " ", HELP[entry.name]).split())
            assert told in listed, entry.name
            own = typer.main.get_command(entry.load()).help or ""
            assert own.startswith(HELP[entry.name]), entry.name


def test_it_is_listed_without_an_import_and_imported_when_called(offer: Offer) -> None:
    offer("paint")
    listed = run_qgs("--help")
    assert "Commands (colours 2.1)" in listed.output
    assert "_test_colours" not in sys.modules
    called = run_qgs("paint", "first", "21")
    assert called.output == "twice 42\n"
    assert "second" in run_qgs("paint", "--help").output


@pytest.mark.parametrize(
    ("code", "reason"),
    [
        ("import no_such_package", "`_test_colours:plugin`: ModuleNotFoundError: No module named"),
        ("plugin = 3", "not a typer.Typer; update colours 2.1"),
        ("raise SystemExit('no display')", "SystemExit: no display; update colours 2.1"),
    ],
)
def test_one_that_cannot_be_used_is_told_and_the_others_work(
    offer: Offer, code: str, reason: str
) -> None:
    offer("paint", code)
    result = run_qgs("paint", "first")
    assert isinstance(result.exception, ValueError)
    assert "the command `qgs paint` of colours 2.1" in str(result.exception)
    assert reason in str(result.exception)
    assert run_qgs("--help").exit_code == 0


def test_of_two_with_one_name_neither_runs(offer: Offer) -> None:
    offer("paint")
    offer("paint", distribution="more-colours")
    result = run_qgs("paint", "first", "1")
    assert "a command" not in result.output
    assert "`qgs paint` of colours 2.1, more-colours 2.1" in str(result.exception)


def test_own_commands_are_never_hidden(offer: Offer) -> None:
    offer("train", "raise RuntimeError")
    assert "Recipe file" in run_qgs("train", "--help").output
    assert "colours" not in run_qgs("--help").output


def test_a_command_of_this_repository_names_its_distribution(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("qgs.cli.installed", lambda group: ())
    result = run_qgs("data", "check", "photos")
    assert "run `pip install query-gaussians-datatools`" in str(result.exception)
    result = run_qgs("bench", "tiny/locus.yaml")
    assert "run `pip install query-gaussians-bench`" in str(result.exception)
    assert run_qgs("nothing").exit_code == 2
    assert DISTRIBUTIONS[GROUP].keys().isdisjoint(COMMANDS)
