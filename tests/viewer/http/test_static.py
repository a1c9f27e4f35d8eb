"""The web server: served files, rejected requests, and clients that disconnect."""

import contextlib
import http.client
import os
import re
import socket
import threading

import pytest
from starlette.requests import Request

from snowsplat.util.errors import UserError
from snowsplat.viewer.hosts import NO_TOKEN, KnownHosts
from snowsplat.viewer.http import guard
from snowsplat.viewer.http.server import WebServer
from snowsplat.viewer.http.static import FileOnDisk, ServedFile, static_app

from ...waiting import wait_until
from .. import clients

SCENE = bytes(range(256)) * 4096  # 1 MiB
FILES = {
    "": ServedFile(b"<!doctype html>", "text/html; charset=utf-8"),
    "scene.ply": ServedFile(SCENE, "application/octet-stream"),
}
POLICY = {"Content-Security-Policy": "default-src 'none'"}


def serve(files, headers, **options) -> WebServer:
    return WebServer(static_app(files), headers=headers, **options)


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    disk = tmp_path_factory.mktemp("served") / "disk.ply"
    disk.write_bytes(SCENE)
    files = FILES | {"disk.ply": FileOnDisk(disk, "application/octet-stream")}
    with serve(files, POLICY) as server:
        yield server


def ask(
    server: WebServer,
    name: str = "",
    method: str = "GET",
    path: str | None = None,
    **headers: str,
) -> tuple[http.client.HTTPResponse, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=10)
    target = path if path is not None else "/" + server.url.split("/", 3)[3] + name
    connection.putrequest(method, target, skip_host="Host" in headers)
    for key, value in headers.items():
        connection.putheader(key.replace("_", "-"), value)
    connection.endheaders()
    response = connection.getresponse()
    body = response.read()
    connection.close()
    return response, body


def test_connections_that_are_gone_end(server):
    kept = server._socket.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
    assert kept


def test_address(server):
    assert re.fullmatch(rf"http://127\.0\.0\.1:{server.port}/[\w-]{{20,}}/", server.url)
    with serve(FILES, POLICY) as other:
        assert other.url.split("/")[3] != server.url.split("/")[3]


def test_whole_files(server):
    response, body = ask(server)
    assert (response.status, body) == (200, b"<!doctype html>")
    assert response.headers["Content-Type"] == "text/html; charset=utf-8"
    assert response.headers["X-Content-Type-Options"] == "nosniff"
    assert response.headers["Content-Security-Policy"] == "default-src 'none'"
    assert response.headers["Referrer-Policy"] == "no-referrer"
    for name in ("scene.ply", "disk.ply"):
        assert ask(server, name)[1] == SCENE
        response, body = ask(server, f"{name}?webgl", method="HEAD")
        assert (response.status, body) == (200, b"")
        assert response.headers["Content-Length"] == str(len(SCENE))
        assert response.headers["Cache-Control"] == "private, no-cache"
    assert response.headers["Accept-Ranges"] == "bytes"


@pytest.mark.parametrize("name", ["scene.ply", "disk.ply"])
def test_unchanged_files_are_not_sent_twice(server, name):
    etag = ask(server, name)[0].headers["ETag"]
    response, body = ask(server, name, If_None_Match=etag)
    assert (response.status, body, response.headers["ETag"]) == (304, b"", etag)
    assert ask(server, name, If_None_Match='"another"')[0].status == 200


@pytest.mark.parametrize(
    ("asked", "start", "end"),
    [
        ("bytes=0-0", 0, 1),
        ("bytes=100-299", 100, 300),
        ("bytes=1048000-", 1048000, 1 << 20),
        ("bytes=-10", (1 << 20) - 10, 1 << 20),
        ("bytes=-9999999", 0, 1 << 20),
        ("bytes=5-99999999999999999999999999", 5, 1 << 20),
    ],
)
def test_ranges(server, asked, start, end):
    response, body = ask(server, "disk.ply", Range=asked)
    assert response.status == 206
    assert body == SCENE[start:end]
    assert response.headers["Content-Range"] == f"bytes {start}-{end - 1}/{1 << 20}"


def test_a_file_in_memory_is_sent_as_a_whole(server):
    response, body = ask(server, "scene.ply", Range="bytes=0-9")
    assert (response.status, body) == (200, SCENE)


def test_a_file_on_disk_in_a_folder_that_is_written_again(tmp_path):
    path = tmp_path / "levels.webp"
    path.write_bytes(SCENE)
    with serve({"0_0/levels.webp": FileOnDisk(path, "image/webp")}, POLICY) as server:
        response, body = ask(server, "0_0/levels.webp")
        assert (body, response.getheader("Content-Type")) == (SCENE, "image/webp")
        assert ask(server, "0_0/../0_0/levels.webp")[0].status == 404
        path.write_bytes(SCENE[:1000])
        etag = response.getheader("ETag")
        response, body = ask(server, "0_0/levels.webp", If_None_Match=etag)
        assert (response.status, body) == (200, SCENE[:1000])


def test_only_the_given_files_are_served(server):
    prefix = "/" + server.url.split("/", 3)[3]
    for path in (
        *("/scene.ply", "/favicon.ico", prefix[:-2], prefix[:-2] + "/", "*"),
        *(prefix + name for name in ("absent", "scene.ply/", ".", "..", "/", "SCENE.PLY", "%00")),
        *(prefix + up + "etc/passwd" for up in ("../" * 9, "..%2f" * 9, "%2e%2e/" * 9, "..\\" * 9)),
        *(prefix + name for name in ("%2Fetc%2Fpasswd", "//etc/passwd", "....//etc/passwd")),
        server.url,  # the form of a request to a proxy
    ):
        response, body = ask(server, path=path)
        assert response.status == 404, path
        assert body in (b"", NO_TOKEN.encode()), path


def test_an_address_without_its_last_slash_leads_to_the_page(server):
    token = server.url.split("/")[3]
    response, _ = ask(server, path=f"/{token}")
    assert (response.status, response.headers["Location"]) == (308, f"{token}/")


@pytest.mark.parametrize(
    "method", ["POST", "PUT", "DELETE", "PATCH", "OPTIONS", "TRACE", "CONNECT"]
)
def test_only_get_and_head(server, method):
    response, _ = ask(server, method=method)
    assert response.status == 405
    assert response.headers["Allow"] == "GET, HEAD"


@pytest.mark.parametrize(
    "host", ["evil.example", "127.0.0.1.evil.example", "10.0.0.1:80", "", "a b"]
)
def test_foreign_hosts_are_rejected(server, host):
    response, body = ask(server, Host=host)
    assert response.status == 421
    assert body.startswith((b"snowsplat does not know the name", b"The request has no valid Host"))


@pytest.mark.parametrize("host", ["localhost", "LOCALHOST:1234", "127.0.0.1:5", "[::1]:99"])
def test_own_names_with_any_port(server, host):
    """With SSH forwarding the browser uses another port."""
    assert ask(server, Host=host)[0].status == 200


def test_hosts_if_other_machines_can_connect():
    assert KnownHosts("0.0.0.0").include("192.168.1.7:8080")
    assert KnownHosts("0.0.0.0").include(f"{socket.gethostname()}:8080")
    assert KnownHosts("::").include("[fe80::1]")
    assert KnownHosts("box.lan").include("box.lan")
    assert not KnownHosts("0.0.0.0").include("evil.example")
    assert not KnownHosts("0.0.0.0").include(socket.gethostname() + ".evil.example")
    assert not KnownHosts("127.0.0.1").include("192.168.1.7")


def test_a_proxy_with_a_public_name(caplog):
    public, inner = "abc-80.proxy.example", "scenes.example"
    with serve(FILES, POLICY, allow_host=[f"{public}, {inner.upper()}."]) as server:
        assert server.others == [
            server.url.replace(f"http://127.0.0.1:{server.port}", f"https://{name}")
            for name in (public, inner)
        ]
        for headers in (
            {"Host": public, "Origin": f"https://{public}"},
            {"Host": f"{inner}:8443", "Origin": f"https://{inner}:8443"},
            {"Host": "127.0.0.1", "Origin": f"https://{public}"},  # the proxy has replaced Host
        ):
            assert ask(server, **headers)[0].status == 200
        assert ask(server, Host=public, Origin="https://evil.example")[0].status == 403
        assert ask(server, Host=f"{public}.evil.example")[0].status == 421
        caplog.clear()
        for _ in range(2):
            body = ask(server, Host="other.example:80")[1].decode()
            assert "start snowsplat again with --allow-host other.example\n" in body
        assert len(caplog.records) == 1
        assert "--allow-host other.example" in caplog.text
        for i in range(50):  # a stranger cannot fill the terminal
            ask(server, Host=f"{i}.example")
        assert len(caplog.records) < 10
        assert ask(server, path="/")[1].decode() == NO_TOKEN
    for wrong in ("https://abc.example/", "a b", "", "x,,y"):
        with pytest.raises(UserError, match="allow_host: .* is not a host name"):
            KnownHosts("127.0.0.1", [wrong])
    assert KnownHosts("127.0.0.1", ["münchen.example"]).include("xn--mnchen-3ya.example")


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "null", "", "http://localhost:1", "http://127.0.0.1:{port}.x"]
)
def test_foreign_pages_are_rejected(server, origin):
    response, body = ask(server, Origin=origin.format(port=server.port))
    assert (response.status, body) == (403, b"")
    assert ask(server, Origin=f"http://127.0.0.1:{server.port}")[0].status == 200


@pytest.mark.parametrize(
    "headers",
    [
        ["Content-Length: 5"],
        ["Transfer-Encoding: chunked"],
        ["Host: localhost", "Host: evil.example"],
    ],
)
def test_ambiguous_requests_are_rejected(server, headers):
    """There is one response with an error, then the connection is closed."""
    path = "/" + server.url.split("/", 3)[3]
    body = f"GET {path}scene.ply HTTP/1.1\r\nHost: localhost\r\n\r\n"
    answer = clients.ask(
        server.url,
        "\r\n".join([f"GET {path} HTTP/1.1", "Host: localhost", *headers, "", body]).encode(),
    )
    assert clients.status(answer) == 400
    assert answer.count(b"HTTP/1.1") == 1
    assert ask(server)[0].status == 200


def test_a_thousand_connections(server):
    """Each sends half a request. Threads and descriptors are limited; who was there is served."""
    threads, descriptors = threading.active_count(), len(os.listdir("/proc/self/fd"))
    known = http.client.HTTPConnection("127.0.0.1", server.port, timeout=20)
    path = "/" + server.url.split("/", 3)[3]
    known.request("GET", path)
    known.getresponse().read()
    strangers = []
    try:
        for i in range(1000):
            client = clients.open_socket(server.url)
            with contextlib.suppress(OSError):
                client.sendall(b"GET / HT" if i % 2 else b"")
            strangers.append(client)
        most = guard.CONNECTIONS + 20
        assert threading.active_count() - threads <= most
        # A connection beyond the limit has a descriptor until the server comes to it.
        own = descriptors + len(strangers)
        wait_until(lambda: len(os.listdir("/proc/self/fd")) - own <= most)
        known.request("GET", path)
        assert known.getresponse().read() == b"<!doctype html>"
    finally:
        known.close()
        for client in strangers:
            client.close()
    wait_until(lambda: threading.active_count() <= threads)


def test_a_browser_that_disconnects_during_a_download(capfd, caplog):
    big = {"big": ServedFile(bytes(64 << 20), "application/octet-stream")}
    with serve(big, {}) as server:
        path = "/" + server.url.split("/", 3)[3] + "big"
        for _ in range(5):
            with socket.create_connection(("127.0.0.1", server.port)) as client:
                client.sendall(f"GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
                client.recv(1000)
        for garbage in (
            b"",
            b"\x16\x03\x01\x00",
            b"GET\r\n\r\n",
            b"x" * 70_000,
            b"GET / HTTP/9\r\n\r\n",
        ):
            with socket.create_connection(("127.0.0.1", server.port)) as client:
                client.sendall(garbage)
        assert len(ask(server, "big")[1]) == 64 << 20
    assert capfd.readouterr() == ("", "")
    assert not caplog.records


def test_a_browser_that_disconnects_during_an_upload(caplog):
    ended = threading.Event()

    async def app(scope, receive, send):
        try:
            await Request(scope, receive).body()
        finally:
            ended.set()

    with WebServer(app, headers=POLICY) as server:
        path = "/" + server.url.split("/", 3)[3]
        with socket.create_connection(("127.0.0.1", server.port)) as client:
            head = f"POST {path} HTTP/1.1\r\nHost: localhost\r\nContent-Length: 9\r\n\r\n"
            client.sendall(f"{head}half".encode())
        assert ended.wait(60)
    assert not caplog.records


def test_close_stops_the_server():
    threads = threading.active_count()
    server = serve(FILES, POLICY)
    server.close()
    assert threading.active_count() <= threads
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", server.port)).close()


def test_unavailable_ports_and_hosts(server):
    with pytest.raises(UserError, match=f"port: {server.port} is in use; choose another"):
        serve(FILES, POLICY, port=server.port)
    with pytest.raises(UserError, match="0 to 65535"):
        serve(FILES, POLICY, port=70_000)
    with pytest.raises(UserError, match="not a name or address of this machine|cannot listen at"):
        serve(FILES, POLICY, host="no-such-host.invalid")
    with pytest.raises(UserError, match=r"192\.0\.2\.1"):
        serve(FILES, POLICY, host="192.0.2.1")
