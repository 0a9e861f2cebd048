"""Who may look at the server of `qgs view`, and what broken clients do to it."""

import http.client
import time
from contextlib import suppress

import pytest
import viser
from qgs_viewer.page import quiet_server
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect


@pytest.fixture(scope="module")
def port():
    with quiet_server() as server:
        yield server.get_port()


def opened(port, origin=None):
    protocol = f"viser-v{viser.__version__}"
    return connect(f"ws://127.0.0.1:{port}", origin=origin, subprotocols=[protocol])


def status(port, host):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.request("GET", "/", headers={"Host": host.format(port)})
    return connection.getresponse().status


def test_the_page_is_served_under_names_of_this_machine_alone(port):
    for host in ("localhost:{}", "127.0.0.1:{}", "[::1]:{}", "192.168.1.7:{}"):
        assert status(port, host) == 200, host
    for host in ("rebound.example:{}", "127.0.0.1.example:{}", ""):
        assert status(port, host) == 403, host


def test_its_own_page_alone_reads_the_scene(port):
    with opened(port, f"http://127.0.0.1:{port}") as socket:
        assert socket.recv(10)
    for origin in ("http://127.0.0.1:1", "https://page.example", "null"):
        with pytest.raises(InvalidStatus):
            opened(port, origin)


def test_a_broken_message_ends_its_connection_alone(port, capfd, caplog):
    for message in (b"\xc1", b"", b"\x81\xa4type\xa4None", "text", b"\x00" * 99):
        with opened(port) as socket, suppress(TimeoutError, ConnectionClosed):
            socket.send(message)
            while True:
                socket.recv(0.5)
        time.sleep(0.1)
        with opened(port) as socket:
            assert socket.recv(10)
    assert "Traceback" not in "".join(capfd.readouterr())
    assert not [record for record in caplog.records if record.exc_info]
