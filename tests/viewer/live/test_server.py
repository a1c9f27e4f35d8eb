"""Ports that are in use, hosts that are not local, and no output."""

import contextlib
import socket
import urllib.request

import pytest

from snowsplat.util.errors import UserError
from snowsplat.viewer.live.server import (
    DEFAULT_PORT,
    address,
    free_port,
    start_server,
    stop_server,
)


@pytest.fixture
def taken():
    """A port that is in use."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        yield listener.getsockname()[1]


def test_a_page_is_served_and_the_port_is_released(capfd):
    port = free_port("127.0.0.1", None)
    assert DEFAULT_PORT <= port < DEFAULT_PORT + 20
    running = start_server("127.0.0.1", port, "a scene")
    running.open()
    server, url = running.server, running.url
    try:
        assert url.startswith(f"http://127.0.0.1:{port}/")
        with urllib.request.urlopen(url) as page:
            assert b"<html" in page.read(1000)
        with pytest.raises(UserError, match=f"port: {port} is in use"):
            free_port("127.0.0.1", port)
        assert free_port("127.0.0.1", None) != port
        assert server.request_share_url() is None
    finally:
        stop_server(server)
    assert free_port("127.0.0.1", port) == port
    assert capfd.readouterr() == ("", "")


def test_a_viser_that_does_not_start_through_the_guard_is_stopped(monkeypatch):
    """It would accept all clients, which is worse than no page."""
    monkeypatch.setattr(
        "snowsplat.viewer.live.server._guarded", lambda guard: contextlib.nullcontext()
    )
    port = free_port("127.0.0.1", None)
    with pytest.raises(RuntimeError, match="is not supported: it starts differently"):
        start_server("127.0.0.1", port, "")
    assert free_port("127.0.0.1", port) == port


def test_unavailable_ports(taken):
    with pytest.raises(UserError, match=f"port: {taken} is in use"):
        start_server("127.0.0.1", taken, "")
    for port in (0, 65536, -1):
        with pytest.raises(UserError, match="use 1 to 65535"):
            free_port("127.0.0.1", port)


def test_another_process_takes_the_free_port_first(taken, monkeypatch):
    monkeypatch.setattr("snowsplat.viewer.live.server.free_port", lambda host, port: taken)
    running = start_server("127.0.0.1", None, "")
    try:
        port = running.server.get_port()
        assert port != taken
        assert running.url.startswith(f"http://127.0.0.1:{port}/")
    finally:
        stop_server(running.server)
    with pytest.raises(UserError, match=f"port: {taken} is in use"):
        start_server("127.0.0.1", taken, "")


@pytest.mark.parametrize("host", ["192.0.2.1", "no-such-host.invalid", "a b"])
def test_hosts_that_are_not_local(host):
    with pytest.raises(UserError, match=f"host: .*{host}"):
        free_port(host, None)


def test_urls_for_browsers():
    assert address("0.0.0.0", 8080, "word") == "http://localhost:8080/word/"
    assert address("::1", 9000, "word") == "http://[::1]:9000/word/"
    assert address("studio", 9000, "word") == "http://studio:9000/word/"
    assert address("::", 8080, "word") == "http://localhost:8080/word/"
