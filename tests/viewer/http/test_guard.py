"""The guard: bodies, WebSockets, and hostile clients of an app."""

import contextlib
import http.client
import threading
import time

import pytest
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from snowsplat.viewer.http.server import WebServer

from .. import clients


async def size(request: Request) -> Response:
    return PlainTextResponse(str(sum([len(block) async for block in request.stream()])))


async def early(request: Request) -> Response:
    return PlainTextResponse("no", 409)


async def broken(request: Request) -> Response:
    raise RuntimeError("a fault")


async def echo(socket: WebSocket) -> None:
    await socket.accept()
    with contextlib.suppress(WebSocketDisconnect):
        while True:
            await socket.send_text(await socket.receive_text())


async def flood(socket: WebSocket) -> None:
    """Sends for ever."""
    await socket.accept()
    while True:
        await socket.send_bytes(bytes(1 << 20))


@pytest.fixture
def server():
    app = Starlette(
        routes=[
            Route("/size", size, methods=["PUT", "POST"]),
            Route("/early", early, methods=["PUT"]),
            Route("/broken", broken),
            WebSocketRoute("/echo", echo),
            WebSocketRoute("/flood", flood),
        ]
    )
    with WebServer(app) as server:
        yield server


def head(server: WebServer, name: str, *headers: str, method: str = "PUT") -> bytes:
    path = clients.path(server.url) + name
    lines = [f"{method} {path} HTTP/1.1", f"Host: 127.0.0.1:{server.port}", *headers, "", ""]
    return "\r\n".join(lines).encode()


def put(server: WebServer, name: str, body: bytes) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=20)
    connection.request("PUT", clients.path(server.url) + name, body)
    response = connection.getresponse()
    answer = response.status, response.read()
    connection.close()
    return answer


def websocket(server: WebServer, name: str, **options):
    return connect(server.url.replace("http", "ws") + name, **options).__enter__()


def test_bodies(server):
    for count in (0, 1, 200_000, 16 << 20):
        assert put(server, "size", bytes(count)) == (200, str(count).encode())


def test_an_answer_before_the_body_is_received(server):
    """The rest of the body is read, and is not taken for a request."""
    request = head(server, "early", "Content-Length: 300000") + bytes(300_000)
    answer = clients.ask(server.url, request + head(server, "size", "Connection: close"))
    assert answer.count(b"HTTP/1.1 409") == answer.count(b"HTTP/1.1 200") == 1


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        (["Content-Length: 10000000000"], 413),
        (["Transfer-Encoding: chunked"], 400),
    ],
)
def test_bodies_that_are_refused(server, headers, status):
    answer = clients.ask(server.url, head(server, "size", *headers))
    assert clients.status(answer) == status


def test_a_fault_of_the_app_is_one_answer(server, caplog):
    answer = clients.get(server.url, clients.path(server.url) + "broken")
    assert clients.status(answer) == 500
    assert "RuntimeError: a fault" in caplog.text
    assert put(server, "size", b"x") == (200, b"1")


def test_websockets(server):
    origin = f"http://127.0.0.1:{server.port}"
    with websocket(server, "echo", origin=origin) as socket:
        socket.send("hello")
        assert socket.recv() == "hello"
    for options, status in (
        ({"origin": "http://evil.example"}, {403}),
        ({"origin": "null"}, {403}),
    ):
        with pytest.raises(InvalidStatus) as refused:
            websocket(server, "echo", **options)
        assert refused.value.response.status_code in status
    upgrade = ["Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13"]
    upgrade += [f"Sec-WebSocket-Key: {'A' * 22}=="]
    path = clients.path(server.url)
    for target, host, status in (
        (f"{path}echo", "evil.example", 421),
        ("/x" + path + "echo", "localhost", 404),
        (f"{path}absent", "localhost", 404),
    ):
        answer = clients.get(server.url, target, f"Host: {host}", *upgrade)
        assert clients.status(answer) == status


@pytest.mark.parametrize("method", ["GET", "POST", "HEAD", "OPTIONS"])
def test_an_upgrade_that_is_no_websocket_is_answered(server, method):
    """The parser of WebSockets refuses other methods; it was never answered."""
    begin = f"{method} {clients.path(server.url)}echo HTTP/1.1"
    upgrade = ["Upgrade: websocket", "Connection: Upgrade, close"]
    answer = clients.ask(
        server.url, "\r\n".join([begin, "Host: localhost", *upgrade, "", ""]).encode()
    )
    assert 400 <= clients.status(answer) < 500


def test_close_ends_websockets():
    app = Starlette(routes=[WebSocketRoute("/echo", echo)])
    threads = threading.active_count()
    server = WebServer(app)
    client = clients.upgrade(server.url, "echo")
    server.close()
    assert threading.active_count() == threads
    with contextlib.suppress(ConnectionError):
        assert client.recv(100) == b""
    client.close()


def test_the_first_free_port_of_several(monkeypatch):
    with WebServer(early, port=None) as first, WebServer(early, port=None) as second:
        assert 8080 <= first.port < second.port < 8100
    monkeypatch.setattr("snowsplat.viewer.hosts._TRIED", 0)
    with pytest.raises(Exception, match="are in use"):
        WebServer(early, port=None)


def test_a_closed_connection_is_not_written_to(server, caplog):
    for _ in range(3):
        client = clients.upgrade(server.url, "flood")
        client.recv(1000)
        clients.reset(client)
    time.sleep(0.3)
    assert put(server, "size", b"x") == (200, b"1")
    assert not caplog.records
