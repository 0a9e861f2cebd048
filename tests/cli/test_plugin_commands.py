"""Commands of other distributions: listed without an import, and told apart when they fail."""

import sys
from collections.abc import Callable
from importlib.metadata import entry_points
from pathlib import Path

import pytest
from typer.testing import CliRunner

from qgs import DISTRIBUTIONS
from qgs.cli import COMMANDS, app
from qgs.cli.plugin_commands import GROUP

Offer = Callable[..., None]
APP = """
import typer
app = typer.Typer()

@app.command()
def first(number: int) -> None:
    print("twice", 2 * number)

@app.command()
def second() -> None:
    pass
"""


@pytest.fixture
def offer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Offer:
    """`offer("name", code, distribution="d")`: installs a distribution with that command."""
    monkeypatch.syspath_prepend(tmp_path)

    def install(name: str, code: str = APP, distribution: str = "colours") -> None:
        module = distribution.replace("-", "_") + "_commands"
        (tmp_path / f"{module}.py").write_text(code)
        info = tmp_path / f"{distribution}-2.1.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Name: {distribution}\nVersion: 2.1\n")
        (info / "entry_points.txt").write_text(f"[{GROUP}]\n{name} = {module}:app\n")
        monkeypatch.delitem(sys.modules, module, raising=False)

    return install


def test_it_is_listed_without_an_import_and_imported_when_called(offer: Offer) -> None:
    offer("paint")
    listed = CliRunner().invoke(app, ["--help"])
    assert "Commands of colours 2.1." in listed.output
    assert "colours_commands" not in sys.modules
    called = CliRunner().invoke(app, ["paint", "first", "21"])
    assert called.output == "twice 42\n"
    assert "second" in CliRunner().invoke(app, ["paint", "--help"]).output


@pytest.mark.parametrize(
    ("code", "reason"),
    [
        ("import no_such_package", "`colours_commands:app`: ModuleNotFoundError: No module named"),
        ("app = 3", "`colours_commands:app` is int, not a typer.Typer; update colours 2.1"),
        ("", "AttributeError"),
        ("raise SystemExit('no display')", "SystemExit: no display; update colours 2.1"),
    ],
)
def test_one_that_cannot_be_used_is_told_and_the_others_work(
    offer: Offer, code: str, reason: str
) -> None:
    offer("paint", code)
    result = CliRunner().invoke(app, ["paint", "first"])
    assert isinstance(result.exception, ValueError)
    assert "the command `qgs paint` of colours 2.1" in str(result.exception)
    assert reason in str(result.exception)
    assert CliRunner().invoke(app, ["--help"]).exit_code == 0


def test_of_two_with_one_name_neither_runs(offer: Offer) -> None:
    offer("paint")
    offer("paint", distribution="more-colours")
    result = CliRunner().invoke(app, ["paint", "first", "1"])
    assert "a command" not in result.output
    told = "several distributions offer the command `qgs paint`: colours 2.1, more-colours 2.1; un"
    assert told in str(result.exception)


def test_own_commands_are_never_hidden(offer: Offer) -> None:
    offer("train", "raise RuntimeError")
    assert "Recipe file" in CliRunner().invoke(app, ["train", "--help"]).output
    assert "colours" not in CliRunner().invoke(app, ["--help"]).output


def test_a_command_of_this_repository_names_its_distribution(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    nothing = entry_points(group="no.such.group")
    monkeypatch.setattr("qgs.cli.plugin_commands.entry_points", lambda **_: nothing)
    result = CliRunner().invoke(app, ["data", "check", "photos"])
    assert "run `pip install query-gaussians-datatools`" in str(result.exception)
    assert CliRunner().invoke(app, ["nothing"]).exit_code == 2
    assert DISTRIBUTIONS[GROUP].keys().isdisjoint(COMMANDS)
