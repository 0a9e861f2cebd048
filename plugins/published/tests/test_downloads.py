"""Checkpoints from servers that refuse, stay silent, drip, or send too much or other things."""

import os
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from commands import MODEL
from qgs_published import downloads
from upath import UPath

import qgs
from qgs.io.checkpoint import save
from qgs.io.models import checkpoint_path
from qgs.terminal import shown, without_secrets

PAGE = b"<!doctype html><html>Log in</html>"


class Server(BaseHTTPRequestHandler):
    """Answers by the first part of the path: a status, or how it sends `content`."""

    content = b""
    ended = threading.Event()

    def do_GET(self) -> None:
        kind, content = self.path.split("/")[1], self.content
        if kind == "login":
            kind = "whole" if self.headers["Authorization"] == "Basic bWU6cEBzcw==" else "401"
        status = int(kind) if kind.isdigit() else 200
        content = {"page": PAGE, "short": content[:-9]}.get(kind, content)
        sizes = {"huge": 10**15, "cut": len(content) + 9}
        if kind == "silent":
            self.ended.wait(30)
        self.send_response(status)
        if kind != "endless":
            self.send_header("Content-Length", str(sizes.get(kind, len(content))))
        self.end_headers()
        sent = content if status == 200 else b""
        for place in range(0, len(sent), 1 if kind == "drip" else len(sent) or 1):
            if kind == "drip":
                self.ended.wait(0.1)
            self.wfile.write(sent[place : place + (1 if kind == "drip" else len(sent))])
        while kind == "endless" and not self.ended.is_set():
            self.wfile.write(content)

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing."""

    def handle(self) -> None:
        with suppress(ConnectionError):  # of a client that has given up
            super().handle()


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    file = tmp_path_factory.mktemp("model") / "a.safetensors"
    save(qgs.compose({"recipe": 1, "model": MODEL}), file)
    return file.read_bytes()


@pytest.fixture
def server(model: bytes, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Its host and port. It has 1 s, and 0.2 s until a wait is reported."""
    monkeypatch.setattr(downloads, "WATCHED", 0.2)
    monkeypatch.setattr(downloads, "PATIENCE", 1.0)
    monkeypatch.setattr(downloads, "LARGEST", 10 * len(model))
    monkeypatch.setattr(Server, "content", model)
    Server.ended.clear()
    running = ThreadingHTTPServer(("127.0.0.1", 0), Server)
    threading.Thread(target=running.serve_forever, daemon=True).start()
    yield f"127.0.0.1:{running.server_port}"
    Server.ended.set()
    running.shutdown()
    running.server_close()


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("QGS_CACHE", str(tmp_path))
    return tmp_path


def files(cache: Path) -> list[str]:
    return sorted(file.name for file in cache.rglob("*") if file.is_file())


@pytest.mark.parametrize(
    ("kind", "cause"),
    [
        ("404", "404"),
        ("401", "401"),
        ("500", "500"),
        ("page", "web page"),
        ("short", "whole safetensors"),
        ("cut", "connection ended"),
        ("huge", "larger than"),
        ("endless", "larger than"),
        ("silent", "0 bytes in 0.2 s"),
        ("drip", "bytes in 0.2 s"),
    ],
)
def test_failures(kind: str, cause: str, server: str, cache: Path, capsys) -> None:
    began = time.monotonic()
    with pytest.raises(OSError, match=rf"{kind}/a\.safetensors.*{cause}") as caught:
        checkpoint_path(f"http://me:p%40ss@{server}/{kind}/a.safetensors?token=hidden")
    assert time.monotonic() - began < 5
    printed = str(caught.value) + capsys.readouterr().err
    assert "p%40ss" not in printed
    assert "hidden" not in printed
    assert caught.value.__suppress_context__
    assert [*cache.iterdir()] == []
    assert printed.count("the download ends in") == (4 if cause.endswith("0.2 s") else 0)


def test_no_server() -> None:
    with pytest.raises(OSError, match=r"nothing was kept: .*refused"):
        checkpoint_path("http://127.0.0.1:9/a.safetensors")


@pytest.mark.parametrize("name", ["", "..", "a" * 300, "%2e%2e"])
def test_any_name_is_kept_in_a_folder_of_the_cache(name, server, model, cache) -> None:
    file = checkpoint_path(f"http://{server}/whole/{name}")
    assert file.read_bytes() == model
    assert file.parent.parent == cache


def test_no_url() -> None:
    with pytest.raises(OSError, match="no URL"):
        checkpoint_path("https://[::1/a.safetensors")


def test_passwords_are_sent_and_never_printed(server: str, model: bytes, capsys) -> None:
    url = f"http://me:p%40ss@{server}/login/a.safetensors"
    assert checkpoint_path(url).read_bytes() == model
    assert "p%40ss" not in capsys.readouterr().err


def test_a_url_is_downloaded_once_and_its_hash_told(model: bytes, cache: Path, capsys) -> None:
    remote = UPath("memory://models/a.safetensors")
    remote.write_bytes(model)
    first = checkpoint_path(str(remote))
    kept = capsys.readouterr().err
    remote.unlink()
    assert checkpoint_path(str(remote)) == first
    again = capsys.readouterr().err
    assert kept.split(",")[0] == again.split(",")[0]
    assert "not downloaded again (delete the file to do so)" in again
    assert files(cache) == ["a.safetensors", "a.safetensors.sha256"]


@pytest.mark.parametrize("damage", ["cut", "turned"])
def test_a_damaged_file_is_replaced(damage: str, server: str, model: bytes, capsys) -> None:
    url = f"http://{server}/whole/a.safetensors"
    file = checkpoint_path(url)
    file.write_bytes(model[:-9] if damage == "cut" else model[:-1] + bytes([model[-1] ^ 1]))
    assert checkpoint_path(url).read_bytes() == model
    assert f"{file} is damaged and is downloaded again" in capsys.readouterr().err


def test_leftovers_of_killed_downloads_are_removed(server: str, cache: Path) -> None:
    for name, age in {"old": 100, "new": 0}.items():
        leftover = cache / name / f".{name}.1.tmp"
        leftover.parent.mkdir()
        leftover.write_bytes(b"part")
        os.utime(leftover, (time.time() - age,) * 2)
    checkpoint_path(f"http://{server}/whole/a.safetensors")
    assert files(cache) == [".new.1.tmp", "a.safetensors", "a.safetensors.sha256"]


@pytest.mark.parametrize(
    ("url", "expected"),
    [
        ("https://me:pass@host:80/a?b=1", "https://***@host:80/a?b=1"),
        ("sftp://me:p@ss@host/a", "sftp://***@host/a"),
        ("sftp://me:p/s?s#w@host/a", "sftp://***@host/a"),
        ("https://host/a#access_token=b", "https://host/a#access_token=***"),
        ("at https://host/a?x=1&X-Amz-Signature=b&y=2", "at https://host/a?x=1&X-Amz-Signature=***&y=2"),
        ("simplecache::https://me:pass@host/a?token=b", "simplecache::https://***@host/a?token=***"),
        ("s3://bucket/a@b", "s3://bucket/a@b"),
        ("a@b ? key=c", "a@b ? key=c"),
    ],
)  # fmt: skip
def test_secrets_in_urls(url: str, expected: str) -> None:
    assert without_secrets(url) == shown(url) == expected


def test_long_text_is_shown_at_once() -> None:
    text = "?token" * 20_000 + "#token" * 20_000 + "://me:" * 20_000
    assert shown(text) == text
