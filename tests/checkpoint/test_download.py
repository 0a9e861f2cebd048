"""Checkpoints from servers that refuse, stay silent, or send too much or other things."""

import re
import time
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Event, Thread

import pytest
import torch
import yaml
from safetensors.torch import save
from tables import contents, must_refuse
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
        self.send_response(int(kind) if kind.isdigit() else 200)
        self.send_header("Location", self.path.replace("302", "login"))
        if kind != "endless":
            self.send_header("Content-Length", str(10**15 if kind == "huge" else len(sent)))
        self.end_headers()
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
    """Its host and port. It may stay silent for 1 s."""
    running = ThreadingHTTPServer(("127.0.0.1", 0), Server)
    Thread(target=running.serve_forever, args=(0.01,), daemon=True).start()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("qgs.checkpoint.models.PATIENCE", 1.0)
        patch.setattr("qgs.checkpoint.models.LARGEST", 10 * len(CONTENT))
        yield f"127.0.0.1:{running.server_port}"
    Server.ended.set()
    running.shutdown()
    running.server_close()


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("QGS_CACHE", str(tmp_path))
    return tmp_path


FAILURES = yaml.safe_load("""
404: "404"
401: "401"
500: "500"
page: web page
short: complete safetensors
huge: larger than
endless: larger than
silent: timed out
""")


def test_failures(server, cache, capsys):
    for kind, cause in FAILURES.items():
        began = time.monotonic()
        url = f"http://me:p%40ss@{server}/{kind}/a.safetensors?token=hidden"
        error = must_refuse(rf"{kind}/a\.safetensors.*{cause}", checkpoint_path, url, kind=OSError)
        assert time.monotonic() - began < 5
        assert not re.search("p%40ss|hidden", str(error) + capsys.readouterr().err)
        assert error.__suppress_context__
        assert error.__cause__ is None
        assert contents(cache) == {}


def test_no_server_and_no_url():
    nowhere = "http://127.0.0.1:9/a.safetensors"
    must_refuse("nothing was kept: .*refused", checkpoint_path, nowhere, kind=OSError)
    must_refuse("not a valid URL", checkpoint_path, "https://[::1/a.safetensors", kind=OSError)


def test_any_name_is_kept_in_a_folder_of_the_cache(server, cache):
    for name in ("", "..", "a" * 300, "%2e%2e"):
        file = checkpoint_path(f"http://{server}/whole/{name}")
        assert file.read_bytes() == CONTENT
        assert file.parent.parent == cache


def test_passwords_are_sent_and_never_printed(server, capsys, caplog):
    url = f"http://me:p%40ss@{server}/login/a.safetensors"
    assert checkpoint_path(url).read_bytes() == CONTENT
    assert "p%40ss" not in capsys.readouterr().err + caplog.text
    # not sent on to where a server leads
    must_refuse("401", checkpoint_path, url.replace("login", "302"), kind=OSError)


def test_a_url_is_downloaded_once_and_where_it_is_kept_is_told(cache, caplog):
    remote = UPath("memory://models/a.safetensors")
    remote.write_bytes(CONTENT)
    first = checkpoint_path(str(remote))
    remote.unlink()
    assert checkpoint_path(str(remote)) == first
    assert f"kept as {first} (delete this file to download it again)" in caplog.text
    assert [file.name for file in contents(cache)] == ["a.safetensors"]


def test_a_damaged_file_is_replaced(server, caplog):
    url = f"http://{server}/whole/a.safetensors"
    file = checkpoint_path(url)
    file.write_bytes(CONTENT[:-9])
    assert checkpoint_path(url).read_bytes() == CONTENT
    assert f"{file} is damaged and is downloaded again" in caplog.text


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
