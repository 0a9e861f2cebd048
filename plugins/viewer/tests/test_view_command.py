"""`qgs view`, without a browser."""

import pytest
import viser
from commands import done
from small import QUERIES, cloud, model_of

import qgs


@pytest.fixture
def ply(tmp_path):
    qgs.save_ply(cloud(5), tmp_path / "a.ply")
    return tmp_path / "a.ply"


@pytest.fixture
def opened(monkeypatch):
    """Addresses that would have been opened; the server ends at once."""
    found = []
    monkeypatch.setattr("webbrowser.open", found.append)
    monkeypatch.setattr(viser.ViserServer, "sleep_forever", lambda self: None)
    return found


def view(*words):
    return done("view", *words, "--device", "cpu").output


def test_it_opens_the_browser_unless_told_not_to(ply, opened):
    told = view(ply, "--port", 0)
    assert [address in told for address in opened] == [True]
    view(ply, "--port", 0, "--no-open")
    assert len(opened) == 1


def test_a_page_shows_the_query_that_was_asked_for(opened, tmp_path):
    model, plain, picked, none = (tmp_path / name for name in ("m.safetensors", *"abc"))
    qgs.save(model_of("locus", "data.image_size=[16, 16]"), model)
    view(model, "--html", plain)
    for where in (["--html", picked], ["--port", 0]):
        view(model, *where, "--query", 3)
    assert picked.read_text() != plain.read_text()
    for where in (["--html", none], ["--port", 0]):
        with pytest.raises(ValueError, match=f"--query {QUERIES}"):
            view(model, *where, "--query", QUERIES)
    assert not none.exists()


def test_a_page_never_replaces_a_file(ply, opened, tmp_path):
    page = tmp_path / "page.html"
    view(ply, "--html", page)
    page.write_text("mine")
    with pytest.raises(FileExistsError):
        view(ply, "--html", page)
    assert page.read_text() == "mine"
    assert not opened
