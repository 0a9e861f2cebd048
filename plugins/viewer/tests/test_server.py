"""Who may look at the server of `qgs view`, and what broken clients do to it."""

import http.client
import time

import pytest
import viser
from qgs_viewer.server import quiet_server
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin, Subprotocol

PROTOCOL = Subprotocol(f"viser-v{viser.__version__}")


@pytest.fixture(scope="module")
def port():
    with quiet_server() as server:
        yield server.get_port()


def opened(port: int, origin: str | None = None) -> ClientConnection:
    given = None if origin is None else Origin(origin)
    return connect(f"ws://127.0.0.1:{port}", origin=given, subprotocols=[PROTOCOL])


def status(port: int, host: str) -> int:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.request("GET", "/", headers={"Host": host})
    return connection.getresponse().status


@pytest.mark.parametrize(
    ("host", "answer"),
    [
        ("localhost:{}", 200),
        ("127.0.0.1:{}", 200),
        ("[::1]:{}", 200),
        ("192.168.1.7:{}", 200),
        ("rebound.example:{}", 403),
        ("127.0.0.1.example:{}", 403),
        ("", 403),
    ],
)
def test_the_page_is_served_under_names_of_this_machine(port, host, answer):
    assert status(port, host.format(port)) == answer


def test_its_own_page_reads_the_scene(port):
    with opened(port, f"http://127.0.0.1:{port}") as socket:
        assert socket.recv(10)


@pytest.mark.parametrize("origin", ["http://127.0.0.1:1", "https://page.example", "null"])
def test_another_page_reads_nothing(port, origin):
    with pytest.raises(InvalidStatus):
        opened(port, origin)


@pytest.mark.parametrize("message", [b"\xc1", b"", b"\x81\xa4type\xa4None", "text", b"\x00" * 99])
def test_a_broken_message_ends_its_connection_alone(port, message, capfd, caplog):
    with opened(port) as socket:
        socket.send(message)
        try:
            while True:
                socket.recv(0.5)
        except (TimeoutError, ConnectionClosed):
            pass
    time.sleep(0.1)
    with opened(port) as socket:
        assert socket.recv(10)
    shown = capfd.readouterr()
    assert "Traceback" not in shown.err + shown.out
    assert not [record for record in caplog.records if record.exc_info]
