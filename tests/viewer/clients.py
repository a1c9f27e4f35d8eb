"""Clients of both pages, on real sockets: well-behaved and hostile ones.

    with Visitor(url) as visitor:
        visitor.view()
        visitor.pictures(1.0)

    HOSTILE["garbage"](url, 1.0)

The clients do not depend on the implementation of the servers.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import json
import os
import random
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable
from typing import Any
from urllib.parse import urlsplit

from PIL import Image
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

POSE = {
    "quat": [1.0, 0.0, 0.0, 0.0],
    "position": [0.0, 0.0, -3.0],
    "fov": 1.0,
    "width": 320,
    "height": 240,
    "photo": None,
}
DISPLAY = {
    "mode": "color",
    "degree": 3,
    "scale": 1.0,
    "wipe": 0.0,
    "longest": 1280,
    "crop": None,
}
_numbers = itertools.count(1)  # of views


def view(**changes: object) -> str:
    """The message of a camera that has moved."""
    return json.dumps({"type": "view", "number": next(_numbers), **POSE, **changes})


def display(**changes: object) -> str:
    """The message of display settings."""
    return json.dumps({"type": "display", **DISPLAY, **changes})


class Visitor:
    """The page without a browser: sends its camera and receives images.

    Attributes:
        told: the newest message of the server of each type.
        keys: the entries of camera lists that it has received.
        shown: number of images; `newest` is the last one, `view_shown` the number of its view.
        thumbnails: indices of the photos of which it has one.
    """

    def __init__(self, url: str, **options: Any) -> None:
        """``options``: those of `websockets.sync.client.connect`."""
        options = {"open_timeout": 20, "close_timeout": 2, "max_size": None, **options}
        address = url.replace("http://", "ws://") + "live"
        self.socket: ClientConnection = connect(address, compression=None, **options).__enter__()
        self.told: dict[str, dict[str, Any]] = {}
        self.keys: list[dict[str, Any]] = []
        self.thumbnails: set[int] = set()
        self.shown = self.view_shown = 0

    def __enter__(self) -> Visitor:
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(OSError, ConnectionClosed):
            self.socket.close()

    def view(self, **changes: object) -> None:
        """Send the camera."""
        self.socket.send(view(**changes))

    def display(self, **changes: object) -> None:
        """Send display settings."""
        self.socket.send(display(**changes))

    def send(self, kind: str, **fields: object) -> None:
        """Send another message."""
        self.socket.send(json.dumps({"type": kind, **fields}))

    def pictures(self, seconds: float, most: int = 1 << 30) -> int:
        """Receive messages for this time, or until ``most`` images; returns their number."""
        before, end = self.shown, time.monotonic() + seconds
        while self.shown - before < most and (left := end - time.monotonic()) > 0:
            try:
                self._take(self.socket.recv(timeout=left))
            except TimeoutError:
                break
        return self.shown - before

    def wait_for(self, kind: str, seconds: float = 20.0) -> dict[str, Any]:
        """Receive messages until one of this type was received; returns the newest one."""
        end = time.monotonic() + seconds
        while kind not in self.told:
            self._take(self.socket.recv(timeout=max(0.0, end - time.monotonic())))
        return self.told[kind]

    @property
    def newest(self) -> Image.Image:
        return Image.open(io.BytesIO(self.jpeg))

    def _take(self, data: str | bytes) -> None:
        if isinstance(data, str):
            message = json.loads(data)
            if message["type"] == "key":
                self.keys.append(message["entry"])
            self.told[message["type"]] = message
            return
        kind, number, view = struct.unpack_from("<BxxxII", data)
        if kind:
            self.thumbnails.add(number)
            return
        self.shown, self.view_shown, self.jpeg = self.shown + 1, view, data[12:]
        self.send("shown", number=number)


def place(url: str) -> tuple[str, int]:
    """Host and port."""
    parts = urlsplit(url)
    assert parts.hostname
    assert parts.port
    return parts.hostname, parts.port


def path(url: str) -> str:
    return urlsplit(url).path or "/"


def open_socket(url: str, seconds: float = 10.0) -> socket.socket:
    return socket.create_connection(place(url), timeout=seconds)


def ask(url: str, request: bytes, seconds: float = 10.0) -> bytes:
    """The response to these bytes, up to the end of the connection."""
    answer = b""
    with open_socket(url, seconds) as client, contextlib.suppress(ConnectionError):
        client.sendall(request)
        while more := client.recv(1 << 16):
            answer += more
    return answer


def get(url: str, target: str | None = None, *headers: str, method: str = "GET") -> bytes:
    """Send a request without encoding; returns head and body of the response."""
    host, port = place(url)
    lines = [f"{method} {path(url) if target is None else target} HTTP/1.1"]
    if not any(line.lower().startswith("host:") for line in headers):
        lines.append(f"Host: {host}:{port}")
    lines += [*headers, "Connection: close", "", ""]
    return ask(url, "\r\n".join(lines).encode("utf-8", "surrogateescape"))


def status(answer: bytes) -> int:
    """The status code; 0 if the connection was closed without a response."""
    return int(answer.split(b" ", 2)[1]) if answer else 0


def upgrade(url: str, name: str = "live") -> socket.socket:
    """A WebSocket connection for hand-written frames; ``name``: its path, relative to the page."""
    client = open_socket(url)
    host, port = place(url)
    client.sendall(
        f"GET {path(url)}{name} HTTP/1.1\r\nHost: {host}:{port}\r\n"
        "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
        f"Sec-WebSocket-Key: {'A' * 22}==\r\n\r\n".encode()
    )
    answer = b""
    while b"\r\n\r\n" not in answer:
        more = client.recv(1)
        if not more:
            raise ConnectionError("refused")
        answer += more
    if b" 101 " not in answer:
        client.close()
        raise ConnectionError(answer.split(b"\r\n")[0].decode())
    return client


def frame(
    content: str | bytes, opcode: int = 1, fin: bool = True, length: int | None = None
) -> bytes:
    """A frame of a client. ``length``: the declared length of the content."""
    payload = content.encode() if isinstance(content, str) else content
    size = len(payload) if length is None else length
    head = bytes([opcode | (0x80 if fin else 0)])
    if size < 126:
        head += bytes([0x80 | size])
    elif size < 1 << 16:
        head += b"\xfe" + struct.pack(">H", size)
    else:
        head += b"\xff" + struct.pack(">Q", size)
    return head + bytes(4) + payload  # a mask of zeros


def reset(client: socket.socket) -> None:
    """Disconnect without a closing handshake."""
    client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    client.close()


def pour(client: socket.socket, data: bytes, seconds: float, read: bool = False) -> int:
    """Send the same data repeatedly, for a time or until the server disconnects."""
    sent, end = 0, time.monotonic() + seconds
    client.settimeout(0.2)
    while time.monotonic() < end:
        try:
            sent += client.send(data)
            if read:
                client.recv(1 << 16)
        except TimeoutError:
            continue
        except OSError:
            break
    return sent


# Hostile clients. Each takes an address and a duration in seconds.


def _garbage(url: str, seconds: float) -> None:
    with upgrade(url) as client:
        for _ in range(200):
            client.sendall(frame(os.urandom(random.randrange(1, 300)), opcode=2))
        client.sendall(frame('{"type": "nothing"}'))
        client.sendall(frame("[" * 60_000))
        client.sendall(frame("9" * 60_000))
        client.sendall(frame(view()[:-5]))
        client.sendall(frame(b"\xff\xfe", opcode=1))
        client.sendall(frame(bytes(100), opcode=11))


#: Values that a field of a message may have, if a hostile client sends it.
WRONG = [
    *(float("nan"), float("inf"), -1, 0, 1e300, -(2**63), 2**64, 10**400, True, "x", None),
    *([], {}, [[1.0]], [1e300] * 3, [float("nan")] * 3, [0.0] * 4, [1e200] * 4, [1e-200] * 4),
]


def wrong_messages() -> list[str]:
    """Messages of the page in which one field is wrong, missing or unknown, and others."""
    found = ["", "null", "[]", "{}", '"view"', '{"type": []}', '{"type": "key", "uuid": 5}']
    for message in (view(), display()):
        known = json.loads(message)
        found += [json.dumps({**known, name: value}) for name in known for value in WRONG]
        found += [json.dumps({k: v for k, v in known.items() if k != name}) for name in known]
        found.append(json.dumps({**known, "more": 1}))
    for kind, name in (
        ("shown", "number"),
        ("thumbnails", "count"),
        ("training", "do"),
        ("share", "share"),
    ):
        found += [json.dumps({"type": kind, name: value}) for value in WRONG]
    found += [json.dumps({"type": "view", **POSE, "number": 1, "photo": n}) for n in (-1, 10**9)]
    return found


def _random_value(depth: int = 0) -> object:
    """A value of JSON. None of them pauses a training."""
    kind = random.randrange(8 if depth < 3 else 5)
    if kind == 0:
        return random.choice(WRONG)
    if kind == 1:
        return random.uniform(-1, 1) * 10.0 ** random.randrange(-320, 308)
    if kind == 2:
        return random.randrange(-(2**70), 2**70)
    if kind == 3:
        return random.choice(["", "view", "color", "x" * random.randrange(3000), "\0\ud800"])
    if kind == 4:
        return random.choice([True, False, None])
    if kind in (5, 6):
        return [_random_value(depth + 1) for _ in range(random.randrange(6))]
    return {str(_random_value(3))[:9]: _random_value(depth + 1) for _ in range(random.randrange(4))}


def _random_message() -> str | bytes:
    """Random bytes, cut and joined messages of the page, and such with random fields."""
    kind = random.randrange(8)
    if kind == 0:
        return random.randbytes(random.randrange(200))
    if kind == 1:
        return random.choice(wrong_messages())
    if kind == 2:
        both = view() + display()
        return both[random.randrange(len(both)) :][: random.randrange(300)]
    if kind == 3:
        return json.dumps(_random_value())
    known = json.loads(random.choice([view(), display(), '{"type": "shown", "number": 1}']))
    if kind == 4:
        known = {"type": random.choice(["training", "share", "key", "x"]), "do": "resume"}
    for _ in range(random.randrange(3)):
        known[random.choice([*known, "do", "share", "number", "more"])] = _random_value()
    return json.dumps(known)


def _random_messages(url: str, seconds: float) -> None:
    """Many more than a page can send; a connection that is closed is made again."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        with contextlib.suppress(OSError):
            client = upgrade(url)
            for _ in range(random.randrange(1, 2000)):
                content = _random_message()
                opcode = 1 if isinstance(content, str) else 2
                if random.random() < 0.002:  # most of these close the connection
                    opcode = random.randrange(16)
                whole = frame(content, opcode, fin=random.random() > 0.001)
                client.sendall(whole if random.random() > 0.001 else whole[: len(whole) // 2])
            reset(client)


def _millions(url: str, seconds: float) -> None:
    with upgrade(url) as client:
        pour(client, frame(view()) * 200, seconds)


def _keys(url: str, seconds: float) -> None:
    """Asks for answers, and reads none; changes its photo all the time."""
    with upgrade(url) as client:
        client.sendall(frame(view()))
        for i in range(900):
            client.sendall(frame('{"type": "key"}'))
            client.sendall(frame(view(photo=i % 3)))
            client.sendall(frame('{"type": "shown", "number": 1000000}'))
            time.sleep(0.01)


def _never_reads(url: str, seconds: float) -> None:
    with upgrade(url) as client:
        end = time.monotonic() + seconds
        turn = 0.0
        with contextlib.suppress(OSError):
            while time.monotonic() < end:
                turn += 0.1
                client.sendall(frame(view(position=[turn, 0.0, -3.0])))
                time.sleep(0.05)


def _half_open(url: str, seconds: float) -> None:
    """Requests sent at one byte per second, many at once."""
    clients = []
    with contextlib.suppress(OSError):
        clients = [open_socket(url) for _ in range(100)]
    end = time.monotonic() + seconds
    request = f"GET {path(url)} HTTP/1.1\r\nHost: localhost\r\nX-Padding: ".encode() + b"x" * 999
    at = 0
    while time.monotonic() < end:
        for client in clients:
            with contextlib.suppress(OSError):
                client.send(request[at : at + 1])
        at += 1
        time.sleep(min(1.0, seconds / 3))
    for client in clients:
        client.close()


def _strangers(url: str, seconds: float) -> None:
    """Connections as fast as possible, each closed at once."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        client = open_socket(url)
        with contextlib.suppress(OSError):
            client.sendall(random.choice((b"", b"\x16\x03\x01\x02", b"GET /x HTTP/1.1\r\n\r\n")))
        reset(client)


def _comers(url: str, seconds: float) -> None:
    """Browsers that connect and disconnect at once."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        with contextlib.suppress(ConnectionError):
            client = upgrade(url)
            client.sendall(frame(view()))
            reset(client)


#: Against the live viewer.
HOSTILE: dict[str, Callable[[str, float], None]] = {
    "garbage": _garbage,
    "random messages": _random_messages,
    "millions of messages": _millions,
    "keys": _keys,
    "never reads": _never_reads,
    "half open": _half_open,
    "strangers": _strangers,
    "comers": _comers,
}


def hostile(kind: str, url: str, seconds: float) -> None:
    """Run a hostile client for a time, or until the server disconnects."""
    with contextlib.suppress(OSError):
        HOSTILE[kind](url, seconds)


def crowd(url: str, seconds: float, kinds: dict[str, int]) -> None:
    """Run several hostile clients at the same time; ``kinds`` has the number of each kind."""
    threads = [
        threading.Thread(target=hostile, args=(kind, url, seconds), daemon=True)
        for kind, count in kinds.items()
        for _ in range(count)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(seconds + 30)


if __name__ == "__main__":  # URL SECONDS KIND=COUNT …: in a separate process
    print("begun", flush=True)
    _kinds = dict(argument.split("=") for argument in sys.argv[3:])
    crowd(sys.argv[1], float(sys.argv[2]), {kind: int(n) for kind, n in _kinds.items()})
