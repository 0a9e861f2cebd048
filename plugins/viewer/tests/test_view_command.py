"""`qgs view`, without a browser."""

from pathlib import Path

import pytest
import torch
import viser
from qgs_viewer.commands import app
from small import QUERIES, model_of
from typer.testing import CliRunner

import qgs
from qgs.types import Gaussians


@pytest.fixture
def ply(tmp_path: Path) -> Path:
    quats = torch.tensor([1.0, 0, 0, 0]).expand(1, 5, 4)
    sizes = torch.full((1, 5, 3), 0.1)
    points = torch.rand(1, 5, 3)
    qgs.save_ply(
        Gaussians(points, sizes, quats, torch.full((1, 5), 0.9), points), tmp_path / "a.ply"
    )
    return tmp_path / "a.ply"


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Addresses that would have been opened; the server ends at once."""
    found: list[str] = []
    monkeypatch.setattr("webbrowser.open", found.append)
    monkeypatch.setattr(viser.ViserServer, "sleep_forever", lambda self: None)
    return found


def view(*arguments: str) -> tuple[str, BaseException | None]:
    result = CliRunner().invoke(app, [*arguments, "--device", "cpu"])
    return result.output, result.exception


def test_it_opens_the_browser_unless_told_not_to(ply: Path, opened: list[str]) -> None:
    told, error = view(str(ply), "--port", "0")
    assert error is None
    assert len(opened) == 1
    assert opened[0] in told
    _, error = view(str(ply), "--port", "0", "--no-open")
    assert error is None
    assert len(opened) == 1


def test_a_page_shows_the_query_that_was_asked_for(opened: list[str], tmp_path: Path) -> None:
    qgs.save(model_of("locus"), tmp_path / "model.safetensors")
    source = str(tmp_path / "model.safetensors")
    _, error = view(source, "--html", str(tmp_path / "plain.html"))
    assert error is None
    _, error = view(source, "--html", str(tmp_path / "picked.html"), "--query", "3")
    assert error is None
    assert (tmp_path / "picked.html").read_text() != (tmp_path / "plain.html").read_text()
    for more in (["--html", str(tmp_path / "none.html")], ["--port", "0"]):
        _, error = view(source, *more, "--query", str(QUERIES))
        assert f"--query {QUERIES}" in str(error)
    assert not (tmp_path / "none.html").exists()
    _, error = view(source, "--port", "0", "--query", "3")
    assert error is None


def test_a_page_never_replaces_a_file(ply: Path, opened: list[str], tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    _, error = view(str(ply), "--html", str(page))
    assert error is None
    page.write_text("mine")
    _, error = view(str(ply), "--html", str(page))
    assert isinstance(error, FileExistsError)
    assert page.read_text() == "mine"
    assert opened == []
