"""Checkpoints from servers that refuse, stay silent, drip, or send too much or other things."""

import os
import re
import time
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Event, Thread

import pytest
import torch
import yaml
from qgs_research.published import downloads
from safetensors.torch import save
from upath import UPath

from qgs.checkpoint.models import checkpoint_path
from qgs.terminal import shown, without_secrets

CONTENT = save({"weight": torch.arange(99.0)})
PAGE = b"<!doctype html><html>Log in</html>"


class Server(BaseHTTPRequestHandler):
    """Answers by the first part of the path: a status, or how it sends CONTENT."""

    ended = Event()

    def do_GET(self):
        kind = self.path.split("/")[1]
        if kind == "login":
            kind = "whole" if self.headers["Authorization"] == "Basic bWU6cEBzcw==" else "401"
        if kind == "silent":
            self.ended.wait(30)
        sent = {"page": PAGE, "short": CONTENT[:-9]}.get(kind, b"" if kind.isdigit() else CONTENT)
        sizes = {"huge": 10**15, "cut": len(sent) + 9}
        self.send_response(int(kind) if kind.isdigit() else 200)
        self.send_header("Location", self.path.replace("302", "login"))
        if kind != "endless":
            self.send_header("Content-Length", str(sizes.get(kind, len(sent))))
        self.end_headers()
        if kind == "drip":
            for byte in sent:
                self.ended.wait(0.1)
                self.wfile.write(bytes([byte]))
        self.wfile.write(sent)
        while kind == "endless" and not self.ended.is_set():
            self.wfile.write(sent)

    def log_message(self, *_):
        """Say nothing."""

    def handle(self):
        with suppress(ConnectionError):  # of a client that has given up
            super().handle()


@pytest.fixture(scope="module")
def server():
    """Its host and port. It has 1 s, and 0.2 s until a wait is reported."""
    running = ThreadingHTTPServer(("127.0.0.1", 0), Server)
    Thread(target=running.serve_forever, args=(0.01,), daemon=True).start()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(downloads, "WATCHED", 0.2)
        patch.setattr(downloads, "PATIENCE", 1.0)
        patch.setattr(downloads, "LARGEST", 10 * len(CONTENT))
        yield f"127.0.0.1:{running.server_port}"
    Server.ended.set()
    running.shutdown()
    running.server_close()


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("QGS_CACHE", str(tmp_path))
    return tmp_path


def files(cache):
    return sorted(file.name for file in cache.rglob("*") if file.is_file())


FAILURES = yaml.safe_load("""
404: "404"
401: "401"
500: "500"
page: web page
short: whole safetensors
cut: connection ended
huge: larger than
endless: larger than
silent: 0 bytes in 0.2 s
drip: bytes in 0.2 s
""")


def test_failures(server, cache, capsys):
    for kind, cause in FAILURES.items():
        began = time.monotonic()
        with pytest.raises(OSError, match=rf"{kind}/a\.safetensors.*{cause}") as caught:
            checkpoint_path(f"http://me:p%40ss@{server}/{kind}/a.safetensors?token=hidden")
        assert time.monotonic() - began < 5
        printed = str(caught.value) + capsys.readouterr().err
        assert not re.search("p%40ss|hidden", printed)
        assert caught.value.__suppress_context__
        assert caught.value.__cause__ is None
        assert [*cache.iterdir()] == []
        assert printed.count("the download ends in") == (4 if cause.endswith("0.2 s") else 0)


def test_no_server_and_no_url():
    with pytest.raises(OSError, match=r"nothing was kept: .*refused"):
        checkpoint_path("http://127.0.0.1:9/a.safetensors")
    with pytest.raises(OSError, match="no URL"):
        checkpoint_path("https://[::1/a.safetensors")


def test_any_name_is_kept_in_a_folder_of_the_cache(server, cache):
    for name in ("", "..", "a" * 300, "%2e%2e"):
        file = checkpoint_path(f"http://{server}/whole/{name}")
        assert file.read_bytes() == CONTENT
        assert file.parent.parent == cache


def test_passwords_are_sent_and_never_printed(server, capsys):
    url = f"http://me:p%40ss@{server}/login/a.safetensors"
    assert checkpoint_path(url).read_bytes() == CONTENT
    assert "p%40ss" not in capsys.readouterr().err
    with pytest.raises(OSError, match="401"):  # not sent on to where a server leads
        checkpoint_path(url.replace("login", "302"))


def test_a_url_is_downloaded_once_and_its_hash_told(cache, capsys):
    remote = UPath("memory://models/a.safetensors")
    remote.write_bytes(CONTENT)
    first = checkpoint_path(str(remote))
    kept = capsys.readouterr().err
    remote.unlink()
    assert checkpoint_path(str(remote)) == first
    again = capsys.readouterr().err
    assert kept.split(",")[0] == again.split(",")[0]
    assert "not downloaded again (delete the file to do so)" in again
    assert files(cache) == ["a.safetensors", "a.safetensors.sha256"]


def test_a_damaged_file_is_replaced(server, capsys):
    url = f"http://{server}/whole/a.safetensors"
    file = checkpoint_path(url)
    for damaged in (CONTENT[:-9], CONTENT[:-1] + b"?"):
        file.write_bytes(damaged)
        assert checkpoint_path(url).read_bytes() == CONTENT
        assert f"{file} is damaged and is downloaded again" in capsys.readouterr().err


def test_leftovers_of_killed_downloads_are_removed(server, cache):
    for name, age in {"old": 100, "new": 0}.items():
        leftover = cache / name / f".{name}.1.tmp"
        leftover.parent.mkdir()
        leftover.touch()
        os.utime(leftover, (time.time() - age,) * 2)
    checkpoint_path(f"http://{server}/whole/a.safetensors")
    assert files(cache) == [".new.1.tmp", "a.safetensors", "a.safetensors.sha256"]


URLS = """
https://<me:pass>@host:80/a?b=1
sftp://<me:p@ss>@host/a
sftp://<me:p/s?s#w>@host/a
https://host/a#access_token=<b>
at https://host/a?x=1&X-Amz-Signature=<b>&y=2
simplecache::https://<me:pass>@host/a?token=<b>
s3://bucket/a@b
a@b ? key=c
"""
"""What stands between angles is not shown."""


def test_secrets_in_urls():
    for text in URLS.splitlines():
        url = re.sub("[<>]", "", text)
        assert without_secrets(url) == shown(url) == re.sub("<.*?>", "***", text)


def test_long_text_is_shown_at_once():
    text = "?token" * 20_000 + "#token" * 20_000 + "://me:" * 20_000
    assert shown(text) == text
