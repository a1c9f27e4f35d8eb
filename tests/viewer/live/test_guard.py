"""Access control of the live viewer, and its limits for hostile clients."""

import contextlib
import gc
import http.client
import logging
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from urllib.parse import urlsplit

import msgspec
import numpy as np
import pytest
import viser
from websockets.exceptions import InvalidMessage, InvalidStatus

from snowsplat.viewer.hosts import NO_TOKEN
from snowsplat.viewer.live.guard import (
    _BROWSERS,
    _PAGES,
    _WAITING,
    ServerTimeLimit,
    is_valid_message,
)
from snowsplat.viewer.live.server import RunningServer, start_server, stop_server

from ..clients import (
    HOSTILE,
    POSE,
    PROTOCOL,
    Visitor,
    ask,
    camera,
    frame,
    get,
    hostile,
    open_socket,
    pour,
    status,
    update,
    upgrade,
)


@pytest.fixture
def local() -> Iterator[RunningServer]:
    running = start_server("127.0.0.1", None, "a scene")
    ServerTimeLimit(running.server, lambda: True)
    running.open()
    yield running
    stop_server(running.server)


@pytest.fixture
def shared() -> Iterator[RunningServer]:
    """A server for other machines, too; its address is the local one."""
    running = start_server("0.0.0.0", None, "a scene")
    running.open()
    yield running
    stop_server(running.server)


def port(running: RunningServer) -> int:
    return running.server.get_port()


def wait(true: Callable[[], bool], seconds: float = 20.0) -> None:
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end
        time.sleep(0.05)


def megabytes() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def refused(url: str, **options: object) -> int:
    with pytest.raises(InvalidStatus) as error:
        Visitor(url, **options)
    return error.value.response.status_code


# Access


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:8080", "127.0.0.1.evil.example", "10.0.0.1", "", "a b"]
)
def test_foreign_hosts_are_rejected(local, host):
    """A foreign domain name may resolve to this machine (DNS rebinding)."""
    assert status(get(local.url, None, f"Host: {host}")) == 421
    upgrading = ["Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13"]
    upgrading += [f"Sec-WebSocket-Key: {'A' * 22}==", f"Sec-WebSocket-Protocol: {PROTOCOL}"]
    assert status(get(local.url, None, f"Host: {host}", *upgrading)) == 421


def test_a_proxy_with_a_public_name(caplog):
    running = start_server("127.0.0.1", None, "a scene", ["abc.example"])
    running.open()
    token = running.url.split("/")[3]
    try:
        assert running.others == [f"https://abc.example/{token}/"]
        origin = "Origin: https://abc.example"
        for host in ("abc.example", "127.0.0.1"):
            assert status(get(running.url, f"/{token}/", f"Host: {host}", origin)) == 200
        with Visitor(running.url, origin="https://abc.example") as visitor:
            visitor.send_camera()
        assert refused(running.url, origin="https://other.example") == 403
        for _ in range(2):
            answer = get(running.url, f"/{token}/", "Host: other.example")
            assert status(answer) == 421
            assert b"start snowsplat again with --allow-host other.example" in answer
        assert [record.levelname for record in caplog.records] == ["WARNING"]
    finally:
        stop_server(running.server)


def test_own_hosts_with_any_port(local):
    for host in ("localhost:9000", "127.0.0.1", "[::1]:1"):
        assert status(get(local.url, None, f"Host: {host}", f"Origin: http://{host}")) == 200


@pytest.mark.parametrize(
    "origin",
    [
        *("http://evil.example", "null", "", "http://localhost:{other}", "http://10.0.0.1:{port}"),
        *("http://127.0.0.1:{port}.evil.example", "file://", "http://localhost:{port}"),
    ],
)
def test_foreign_pages_are_rejected(local, origin):
    origin = origin.format(port=port(local), other=port(local) + 1)
    if origin:  # else the client sends none
        assert refused(local.url, origin=origin) == 403
    assert status(get(local.url, None, f"Origin: {origin}")) == 403


def test_the_page_itself_is_accepted(local, shared):
    for running in (local, shared):
        parts = urlsplit(running.url)
        with Visitor(running.url, origin=f"http://{parts.netloc}") as visitor:
            visitor.send_camera()
            wait(lambda running=running: len(running.server.get_clients()) == 1)
    assert local.others == []


@pytest.mark.parametrize("name", ["local", "shared"])
def test_others_need_the_token(name, request):
    """Other machines, and other users of this machine."""
    shared = request.getfixturevalue(name)
    token = shared.url.split("/")[3]
    assert len(token) >= 20
    if name == "shared":
        assert shared.others == [f"http://{socket.gethostname()}:{port(shared)}/{token}/"]
    with_token = get(shared.url)
    assert status(with_token) == 200
    assert b"<html" in with_token
    assert status(get(shared.url, f"/{token}")) == 200
    assert status(get(shared.url, f"/{token}/?websocket=x")) == 200
    root = f"http://localhost:{port(shared)}"
    for path in ("", "/" + token[:-1], f"/{token}x", f"/x/{token}", f"/{token.swapcase()}"):
        answer = get(root, (path or "/") + "/")
        assert status(answer) == 404, path
        content = answer.partition(b"\r\n\r\n")[2].decode()
        assert content == ("" if path else NO_TOKEN), path
        assert refused(root + path) == 404, path
    assert refused(f"{root}/%2e/{token}") == 404
    other = start_server("0.0.0.0", None, "a scene")
    assert status(get(other.url)) == 503  # rejected before it is opened
    stop_server(other.server)
    assert other.url.split("/")[3] != token


# Served files


def test_only_the_page_is_served(local, shared):
    for running in (local, shared):
        root = urlsplit(running.url).path.rstrip("/")
        for path in (
            *("//", "/.", "/..", "/./", "/index.html/", "/index", "/build", "/favicon.ico", "/%00"),
            *(
                "/../" * 9 + "etc/passwd",
                "/..%2f" * 9 + "etc/passwd",
                "/%2e%2e" * 9 + "/etc/passwd",
            ),
            *("/%252e%252e" * 9 + "/etc/passwd", "/..\\" * 9 + "etc/passwd", "//etc/passwd"),
            *("/..%5c" * 9 + "etc/passwd", "/../package.json", "/\udcff", "/" + "a" * 7000),
        ):
            answer = get(running.url, root + path)
            assert status(answer) == 404, path
            assert b"root:" not in answer
        for target in ("*", running.url, "http://evil.example/", "evil.example:80"):
            assert status(get(running.url, target)) == 404, target


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS", "TRACE", "CONNECT", "get"])
def test_only_get_and_head(local, method):
    assert status(get(local.url, None, method=method)) in (0, 400, 405, 501)


@pytest.mark.parametrize(
    "headers",
    [
        ["Content-Length: 5", "Content-Length: 6"],
        ["Content-Length: 50"],
        ["Transfer-Encoding: chunked"],
        ["Transfer-Encoding: chunked", "Content-Length: 3"],
        ["Host: localhost", "Host: evil.example"],
        ["Host : localhost"],
        ["X: y\r\n folded"],
        [f"X: {'y' * 17_000}"],
        [f"X-{i}: {'y' * 900}" for i in range(40)],
        [f"X-{i}: y" for i in range(300)],
        ["Origin: http://localhost", "Origin: http://evil.example"],
        ["Upgrade: websocket", "Upgrade: h2c"],
        ["Upgrade: h2c"],
    ],
)
def test_ambiguous_requests_are_rejected(local, headers):
    answer = get(local.url, None, *headers)
    assert status(answer) in (0, 400, 413, 431)
    assert answer.count(b"HTTP/1.1") <= 1
    assert status(get(local.url)) == 200


def test_the_page_cannot_be_framed_or_read_by_other_pages(local):
    connection = http.client.HTTPConnection("127.0.0.1", port(local))
    connection.request("GET", urlsplit(local.url).path)
    headers = connection.getresponse().headers
    assert headers["Content-Security-Policy"] == "frame-ancestors 'self'"
    assert headers["Cross-Origin-Resource-Policy"] == "same-origin"
    assert headers["Referrer-Policy"] == "no-referrer"
    assert "Python" not in headers["Server"]
    connection.close()


# Messages


def test_messages():
    assert is_valid_message(camera())
    assert is_valid_message(update("a", 5))
    assert is_valid_message(update("a", [0.5, 1]))
    click = {"type": "SceneNodeClickMessage", "name": "/photos/3", "instance_index": None}
    click |= {"ray_origin": [0, 0, 0], "ray_direction": [0, 0, 1.5], "screen_pos": [0.5, 0.5]}
    assert is_valid_message(msgspec.msgpack.encode({**click, "modifier": None, "owner": ""}))
    command = {"type": "CommandTriggerMessage", "uuid": "a"}
    assert is_valid_message(msgspec.msgpack.encode(command))
    for bad in ({"uuid": 1}, {"uuid": "a" * 201}, {"label": "a"}):
        assert not is_valid_message(msgspec.msgpack.encode(command | bad))
    for name in POSE:
        for bad in (float("nan"), "x", None, [], [1.0, 2.0], b"x", {}):
            sane = name in ("near", "far") and isinstance(bad, float)  # not used
            assert is_valid_message(camera(**{name: bad})) is sane, (name, bad)
    for name in ("image_width", "image_height"):
        for size in (0, -1, 1 << 20, 1e300):
            assert not is_valid_message(camera(**{name: size}))
    # viser sets any attribute that is named.
    for name in ("removed", "sync_cb", "update_cb", "label", "order"):
        assert not is_valid_message(update("a", 5, name))
    assert not is_valid_message(msgspec.msgpack.encode({"type": "GuiUpdateMessage", "uuid": "a"}))
    for value in ({}, {"a": 1}, "x" * 300, [1] * 20, [float("nan")], [[1]], float("inf")):
        assert not is_valid_message(update("a", value))
    for kind in (*("GuiFormDirtyMessage", "FileTransferStartUpload", "ShareUrlDisconnect"), "x"):
        assert not is_valid_message(msgspec.msgpack.encode({"type": kind, "uuid": "a"}))
    for data in (b"", b"\xc1", b"\x91" * 60_000, os.urandom(500), b"\xdf\xff\xff\xff\xff"):
        assert not is_valid_message(data)
    assert not is_valid_message(camera().decode("latin-1"))


def test_a_client_of_another_version_is_rejected(local, capfd):
    """viser would print the name of such a client to the terminal."""
    assert refused(local.url, subprotocols=["viser-v0.0.0"]) == 400
    assert refused(local.url, subprotocols=None) == 400
    assert refused(local.url, subprotocols=[PROTOCOL, "x"]) == 400
    assert capfd.readouterr() == ("", "")


def test_invalid_messages_are_ignored(local, capfd, caplog):
    """The server prints nothing, stores nothing, and serves the next client."""
    logging.getLogger("websockets.server").filters.clear()  # viser's own, since its first request
    for garbage in (b"\x16\x03\x01\r\n\r\n", b"POST / HTTP/1.1\r\n\r\n", b""):
        ask(local.url, garbage + b"\r\n")
    names: list[str] = []
    slider = local.server.gui.add_slider("x", 0, 10, 1, 5)
    slider.on_update(lambda _: names.append("x"))
    with Visitor(local.url) as visitor:
        visitor.send_camera()
        wait(lambda: len(local.server.get_clients()) == 1)
        for value in ("nonsense", None, [], float("nan"), [1, 2, 3], True, 2**64 - 1):
            visitor.socket.send(update(slider._impl.uuid, value))
        visitor.socket.send(update(slider._impl.uuid, 1, "removed"))
        visitor.socket.send(update(slider._impl.uuid, "gone", "sync_cb"))
        visitor.socket.send(update(slider._impl.uuid, 7))
        wait(lambda: slider.value == 7)
    threads = [
        threading.Thread(target=hostile, args=(kind, local.url, 1.0)) for kind in sorted(HOSTILE)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    wait(lambda: not local.server.get_clients())
    with Visitor(local.url) as visitor:
        visitor.send_camera()
        wait(lambda: len(local.server.get_clients()) == 1)
    assert capfd.readouterr() == ("", "")
    gc.collect()  # asyncio then reports exceptions that were never retrieved
    time.sleep(0.1)
    assert [each for each in caplog.records if each.levelno >= logging.WARNING] == []


def is_cut_off(client: socket.socket, seconds: float = 5.0) -> bool:
    client.settimeout(seconds)
    with contextlib.suppress(TimeoutError):
        try:
            while client.recv(1 << 16):
                pass
        except ConnectionError:
            pass
        return True
    return False


@pytest.mark.parametrize(
    "data",
    [
        frame(bytes(125), opcode=9) * 2000,  # pings, which require responses
        frame(camera()) * 2000,
        frame(b"x", fin=False) + frame(b"", opcode=0, fin=False) * 20,  # a message without an end
        frame(b"", length=1 << 62),
        frame(b"", length=1 << 17),
        frame(b"x", opcode=11),
    ],
)
def test_floods_are_disconnected(local, data):
    with upgrade(local.url) as client:
        with contextlib.suppress(OSError):
            client.sendall(data)
        assert is_cut_off(client)
    with upgrade(local.url) as client:  # a valid message, but too often
        for _ in range(100):
            client.sendall(frame(camera()))
            time.sleep(0.002)
        assert not is_cut_off(client, 0.2)


def test_hostile_messages_leave_no_memory(local):
    hostile("millions of messages", local.url, 0.3)
    before = megabytes()
    for kind in ("pings", "millions of messages", "pieces", "huge frame", "forms"):
        hostile(kind, local.url, 1.0)
    assert megabytes() - before < 24
    assert len(local.server._websock_server._broadcast_buffer.message_from_id) < 100


def test_a_client_that_does_not_read_is_not_read_from(local):
    """Images that are not received replace one another; its messages are not read."""
    heard = 0

    async def moved(_: object) -> None:
        nonlocal heard
        heard += 1

    @local.server.on_client_connect
    async def _(client: viser.ClientHandle) -> None:
        client.camera.on_update(moved)

    with upgrade(local.url) as client:
        client.sendall(frame(camera()))
        wait(lambda: len(local.server.get_clients()) == 1)
        (handle,) = local.server.get_clients().values()
        noise = np.random.default_rng(0).integers(0, 255, (720, 1280, 3), np.uint8)
        before = 0.0
        for i in range(100):  # 70 MB if all were kept
            if i == 20:  # what the system and one message take
                before = megabytes()
            handle.scene.set_background_image(noise, format="jpeg", jpeg_quality=90)
            handle.flush()
            time.sleep(0.005)
        assert megabytes() - before < 16
        wait(lambda: heard > 0)
        said = heard
        pour(client, frame(camera()), 0.5)
        time.sleep(0.3)
        assert heard - said < 40


# Limits of connections


def test_the_number_of_connections_is_limited(local):
    """With a thousand connections, descriptors and threads are limited; the next is served."""
    threads = threading.active_count()
    descriptors = len(os.listdir("/proc/self/fd"))
    clients = []
    try:
        for i in range(1000):
            client = open_socket(local.url)
            with contextlib.suppress(OSError):
                client.sendall(b"GET / HT" if i % 2 else b"")
            clients.append(client)
            if i % 100 == 99:
                assert status(get(local.url)) == 200
        own = len(os.listdir("/proc/self/fd")) - descriptors - len(clients)
        assert own <= _WAITING + _PAGES + _BROWSERS + 100  # it takes up to 100 at a time
        assert threading.active_count() <= threads  # none per connection
        with Visitor(local.url) as visitor:
            visitor.send_camera()
            wait(lambda: len(local.server.get_clients()) == 1)
    finally:
        for client in clients:
            client.close()
    wait(lambda: len(os.listdir("/proc/self/fd")) <= descriptors + 2)


def test_the_number_of_browsers_is_limited(local):
    with contextlib.ExitStack() as stack:
        for _ in range(_BROWSERS):
            stack.enter_context(Visitor(local.url))
        assert refused(local.url) == 503
        assert status(get(local.url)) == 200
    wait(lambda: status(get(local.url)) == 200)

    def is_free() -> bool:
        with contextlib.suppress(InvalidStatus, InvalidMessage), Visitor(local.url):
            return True
        return False

    wait(is_free)


def test_unread_page_downloads_are_limited(local):
    """Each unread download uses as much memory as the page."""
    place = urlsplit(local.url)
    request = f"GET {place.path} HTTP/1.1\r\nHost: {place.netloc}\r\n\r\n".encode()
    assert status(ask(local.url, request)) == 200
    clients = []
    for _ in range(3 * _PAGES):
        client = socket.socket()
        client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        client.settimeout(20)
        client.connect(("127.0.0.1", port(local)))
        client.sendall(request)
        clients.append(client)
    answers = [client.recv(12)[-3:] for client in clients]
    assert answers.count(b"200") == _PAGES
    assert answers.count(b"503") == 2 * _PAGES
    for client in clients:
        client.close()
    wait(lambda: status(get(local.url)) == 200)
