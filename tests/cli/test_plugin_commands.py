"""Commands of other distributions: listed without an import, and told apart when they fail."""

import sys
from functools import partial
from importlib.metadata import entry_points

import pytest
import typer
from commands import done, run_qgs

from qgs import DISTRIBUTIONS
from qgs.cli import COMMANDS, GROUP, HELP

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


def test_our_own_commands_are_listed_by_what_they_do():
    """In the words of the commands themselves, which are not imported for it."""
    assert HELP.keys() == DISTRIBUTIONS[GROUP].keys()
    assert HELP["data"] in run_qgs("--help").output
    for entry in entry_points(group=GROUP):
        own = typer.main.get_command(entry.load()).help
        assert own.startswith(HELP.get(entry.name, own)), entry.name


def test_it_is_listed_without_an_import_and_imported_when_called(offer):
    offer("colours", "paint", APP)
    assert "Commands (colours 2.1)" in run_qgs("--help").output
    assert "_test_colours" not in sys.modules
    assert run_qgs("paint", "first", "21").output == "twice 42\n"
    assert "second" in run_qgs("paint", "--help").output


@pytest.mark.parametrize(
    ("code", "reason"),
    [
        ("import no_such_package", "`_test_colours:plugin`: ModuleNotFoundError: No module named"),
        ("plugin = 3", "not a typer.Typer; update colours 2.1"),
        ("raise SystemExit('no display')", "SystemExit: no display; update colours 2.1"),
    ],
)
def test_one_that_cannot_be_used_is_told_and_the_others_work(offer, code, reason):
    offer("colours", "paint", code)
    with pytest.raises(ValueError, match=r"the command `qgs paint` of colours 2\.1") as error:
        done("paint", "first")
    assert reason in str(error.value)
    done("--help")


def test_of_two_with_one_name_neither_runs_and_our_own_are_never_hidden(offer):
    offer("colours", "paint", APP)
    offer("more-colours", "paint", APP)
    result = run_qgs("paint", "first", "1")
    assert "`qgs paint` of colours 2.1, more-colours 2.1" in str(result.exception)
    offer("trains", "train", "raise RuntimeError")
    assert "Recipe file" in run_qgs("train", "--help").output
    assert "trains" not in run_qgs("--help").output


def test_a_command_of_this_repository_names_its_distribution(monkeypatch):
    monkeypatch.setattr("qgs.cli.installed", lambda group: ())
    for command, name in (("data", "datatools"), ("bench", "bench")):
        told = str(run_qgs(command, "tiny/locus.yaml").exception)
        assert f"run `pip install query-gaussians-{name}`" in told
    assert run_qgs("nothing").exit_code == 2
    assert DISTRIBUTIONS[GROUP].keys().isdisjoint(COMMANDS)
