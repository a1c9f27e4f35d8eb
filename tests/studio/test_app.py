"""Requests of the page, and hostile ones."""

import contextlib
import io
import random
import time
from pathlib import Path
from urllib.parse import quote

import pytest
from PIL import Image
from starlette.applications import Starlette
from starlette.routing import WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect
from websockets.exceptions import ConnectionClosedOK
from websockets.sync.client import connect

from snowsplat.studio import job
from snowsplat.viewer.http.server import WebServer

from ..viewer import clients
from ..waiting import wait_until


def files(folder: Path) -> set[str]:
    return {str(path) for path in folder.rglob("*")}


def new(studio, **wanted) -> str:
    status, answer = studio.ask("scenes", "POST", {"title": "a", **wanted})
    assert status == 200
    return answer["name"]


def test_the_page_and_its_parts(studio):
    status, page = studio.ask("")
    assert status == 200
    for name in ("studio.js", "scene.js", "upload.js", "page.js", "text.js", "studio.css"):
        assert studio.ask(name)[0] == 200, name
    assert b'src="studio.js"' in page
    status, about = studio.ask("about?path=scenes/a/site/index.html")
    look = studio.server._guard.look("scenes/a/site")
    assert about["addresses"][0]["url"] == f"http://192.168.1.7:80/{look}/scenes/a/site/index.html"
    assert about["addresses"][0]["code"].startswith("data:image/svg+xml")
    assert about["look"] == f"../{look}/scenes/a/site/index.html"


def test_a_link_that_only_shows_a_scene_with_any_name(studio):
    name = new(studio, title="Ein Tisch, 木 50%")
    site = studio.library.find(name).site
    site.mkdir()
    (site / "a.json").write_text("{}")
    path = quote(f"scenes/{name}/site/a.json")
    look = studio.ask(f"about?path={quote(path)}")[1]["look"]
    assert studio.ask(look.removeprefix(".."))[0] == 200


def test_an_upload_and_what_became_of_it(studio):
    name = new(studio)
    assert studio.ask("scenes")[1][0]["status"] == "new"
    address = f"scenes/{name}/uploads?path=b/photo.jpg&size=6&modified=7000"
    assert studio.ask(f"{address}&start=0", "PUT", b"abc") == (200, {"received": 3})
    status, answer = studio.ask(f"{address}&start=0", "PUT", b"abc")
    assert (status, answer["received"]) == (409, 3)
    assert studio.ask(f"{address}&start=3", "PUT", b"def") == (200, {"received": 6})
    assert studio.ask(f"scenes/{name}/uploads") == (
        200,
        [{"path": "b/photo.jpg", "size": 6, "modified": 7000, "received": 6}],
    )
    scene = studio.library.find(name)
    assert (scene.photos / "b/photo.jpg").read_bytes() == b"abcdef"


def test_start_and_stop(studio, holder):
    name = new(studio)
    status, answer = studio.ask(f"scenes/{name}/start", "POST", {"quality": "draft"})
    assert (status, "no photos yet" in answer["error"]) == (400, True)
    studio.ask(f"scenes/{name}/uploads?path=a.jpg&size=1&modified=7000&start=0", "PUT", b"x")
    for wanted in ({"quality": "great"}, {"minutes": 0}, {"minutes": -1}):
        assert studio.ask(f"scenes/{name}/start", "POST", wanted)[0] == 400
    assert studio.ask(f"scenes/{name}/start", "POST", b"[]")[0] == 400
    assert studio.ask(f"scenes/{name}/start", "POST", {"minutes": 5, "title": "b"})[0] == 200
    status, answer = studio.ask(f"scenes/{name}/start", "POST", {"quality": "best"})
    assert (status, answer["error"]) == (400, "this scene is being made already")
    scene = studio.ask(f"scenes/{name}")[1]
    assert (scene["status"], scene["minutes"], scene["title"]) == ("running", 5, "b")
    assert "--minutes 5" in scene["command"]
    status, answer = studio.ask(
        f"scenes/{name}/uploads?path=b.jpg&size=1&modified=7000&start=0", "PUT", b"x"
    )
    assert (status, "is being made" in answer["error"]) == (400, True)
    while "process" not in studio.library.find(name).state():
        time.sleep(0.05)
    assert studio.ask(f"scenes/{name}/stop", "POST", {})[0] == 200
    while studio.ask(f"scenes/{name}")[1]["status"] == "running":
        time.sleep(0.05)
    assert studio.ask(f"scenes/{name}")[1]["status"] == "stopped"
    (
        studio.library.find(name).folder / "state.json"
    ).unlink()  # it was killed before it said a word
    assert studio.ask(f"scenes/{name}")[1]["status"] == "interrupted"


def test_the_example_takes_its_photos_first(studio, forked):
    status, answer = studio.ask("scenes", "POST", {"title": "Example", "example": True})
    assert status == 200
    scene = studio.library.find(answer["name"])
    wait_until(lambda: scene.state().get("now", {}).get("stage") == "demo", 60)
    studio.ask(f"scenes/{scene.name}/stop", "POST", {})
    wait_until(lambda: not job.is_running(scene), 60)
    assert scene.state()["outcome"] == "stopped"
    # It goes on from there.
    assert scene.inputs() == [scene.photos]
    assert studio.ask(f"scenes/{scene.name}/start", "POST", {"quality": "draft"}) == (200, {})
    wait_until(lambda: scene.state().get("now", {}).get("stage") == "demo", 60)
    studio.ask(f"scenes/{scene.name}/stop", "POST", {})
    wait_until(lambda: not job.is_running(scene), 60)


def test_a_damaged_scene_does_not_hide_the_others(studio):
    name, other = new(studio), new(studio)
    (studio.library.find(name).folder / "job.json").write_text("{")
    listed = {scene["name"]: scene["status"] for scene in studio.ask("scenes")[1]}
    assert listed == {name: "failed", other: "new"}
    assert studio.ask(f"scenes/{name}")[0] == 400


def test_small_photos_of_a_dataset(studio):
    name = new(studio)
    folder = studio.library.find(name).made / "dataset/input"
    folder.mkdir(parents=True)
    Image.new("RGB", (2000, 1000), "red").save(folder / "a.jpg")
    (folder / "b.jpg").write_bytes(b"damaged")
    listed = [{"name": photo, "placed": True} for photo in ("a.jpg", "b.jpg")]
    assert studio.ask(f"scenes/{name}/photos") == (200, listed)
    small = Image.open(io.BytesIO(studio.ask(f"scenes/{name}/photos/0")[1]))
    assert small.size == (320, 160)
    assert studio.ask(f"scenes/{name}/photos/1")[0] == 400
    assert studio.ask(f"scenes/{name}/photos/2")[0] == 404


def test_the_page_of_a_running_training_is_passed_on(studio, monkeypatch):
    """Its images, in both directions; its own address is not told."""

    async def images(socket: WebSocket) -> None:
        await socket.accept()
        with contextlib.suppress(WebSocketDisconnect):
            while True:
                await socket.send_bytes(100_000 * (await socket.receive_text()).encode())

    page = Starlette(routes=[WebSocketRoute("/live", images)])
    name = new(studio)
    scene = studio.library.find(name)
    live = f"{studio.server.url.replace('http', 'ws', 1)}scenes/{name}/live/live"
    monkeypatch.setattr(job, "is_running", lambda scene, task="make": task == "make")
    with connect(live) as socket, pytest.raises(ConnectionClosedOK):
        socket.recv()
    with WebServer(page) as job_page:
        scene.write_state({"page": job_page.url})
        for other in ("absent", "../..", "%2e%2e/", "//evil.example"):
            assert studio.ask(f"scenes/{name}/live/{other}")[0] == 404
        told = studio.ask(f"scenes/{name}")[1]
        assert told["has_page"]
        assert job_page.url not in str(told)
        with connect(live, max_size=None) as socket:
            for text in ("a", "b"):
                socket.send(text)
                assert socket.recv() == 100_000 * text.encode()
    with connect(live) as socket, pytest.raises(ConnectionClosedOK):  # the training has ended
        socket.recv()


def test_folders_of_the_machine(studio, tmp_path):
    (tmp_path / "tour").mkdir()
    (tmp_path / "tour/a.jpg").touch()
    status, listing = studio.ask(f"browse?path={tmp_path}")
    assert "tour" in listing["folders"]
    assert studio.ask(f"browse?path={tmp_path}/tour")[1]["photos"] == 1
    for wrong in (f"{tmp_path}/absent", f"{tmp_path}/tour/a.jpg", "%00"):
        status, answer = studio.ask(f"browse?path={wrong}")
        assert status == 400
        assert "\n" not in answer["error"]
    scene = studio.library.find(new(studio, title="", path=str(tmp_path / "tour")))
    assert (scene.job.title, scene.inputs()) == ("tour", [tmp_path / "tour"])
    address = f"scenes/{scene.name}/uploads?path=x&size=1&modified=7000&start=0"
    assert "add the photos there" in studio.ask(address, "PUT", b"x")[1]["error"]
    for wrong in ("tour", "~nobody-of-this-name/x", "/\ud800", "/a\0b", "/" + 5000 * "x"):
        status, answer = studio.ask("scenes", "POST", {"path": wrong})
        assert status == 400, wrong[:40]
        assert "\n" not in answer["error"]
    for title in ("\ud800", "\0\n", "..", "x" * 10_000, "<b>", {"a": 1}, None):
        assert studio.ask(f"scenes/{quote(new(studio, title=title))}")[0] == 200, title
    assert studio.ask("scenes", "POST", {"path": str(tmp_path / "absent")})[0] == 400


@pytest.mark.parametrize("up", ["../", "..%2f", "%2e%2e/", "..%5c", "/", "%2f", "....//"])
def test_only_files_of_a_scene_are_sent(studio, tmp_path, up):
    secret = tmp_path / "secret.txt"
    secret.write_text("secret")
    name = new(studio)
    scene = studio.library.find(name)
    for folder in (scene.site, scene.made):
        folder.mkdir()
        (folder / "page.html").write_text("page")
        (folder / "link").symlink_to(secret)
    look = studio.ask(f"scenes/{name}")[1]["made"].removeprefix("..")
    for kind, begin in (("site", f"scenes/{name}/site/"), ("made", look)):
        assert studio.ask(f"{begin}page.html") == (200, b"page"), kind
        for path in (up * 4 + "secret.txt", "link", up + "job.json", f"{up}{secret}", 5000 * "x"):
            status, answer = studio.ask(f"{begin}{path}")
            assert status in (400, 404), path
            assert answer != b"secret"
    for path in (f"scenes/{up}library", f"scenes/{up}{up}", f"scenes/{name}/exports/{up}x"):
        assert studio.ask(path)[0] in (400, 404, 405), path


def test_foreign_pages_change_nothing(studio):
    before = files(studio.library.folder)
    for headers in ({"Host": "evil.example"}, {"Origin": "http://evil.example"}):
        for method, path in (("POST", "scenes"), ("GET", "scenes"), ("GET", "browse")):
            body = {"title": "x"} if method == "POST" else None
            assert studio.ask(path, method, body, **headers)[0] in (403, 421)
    assert files(studio.library.folder) == before


def test_claims_and_floods_write_nothing_outside(studio, tmp_path):
    """10 GB that are claimed, paths that lead elsewhere, bodies that do not end."""
    name = new(studio)
    base = clients.path(studio.server.url)
    host = f"Host: 127.0.0.1:{studio.server.port}"
    target = f"{base}scenes/{name}/uploads?path=x&size=10000000000&modified=0&start=0"
    head = f"PUT {target} HTTP/1.1\r\n{host}\r\n"
    answer = clients.ask(studio.server.url, f"{head}Content-Length: 10000000000\r\n\r\n".encode())
    assert clients.status(answer) == 413
    status, answer = studio.ask(
        f"scenes/{name}/uploads?path=x&size=1{'0' * 16}&modified=7000&start=0", "PUT", b"x"
    )
    assert (status, "do not fit" in answer["error"]) == (507, True)
    for size, start in (("-1", "0"), ("x", "0"), ("1" * 30, "0"), ("1", "%C2%B2"), ("", "")):
        path = f"scenes/{name}/uploads?path=x&size={size}&modified=7000&start={start}"
        assert studio.ask(path, "PUT", b"x")[0] == 400
    outside = files(tmp_path) - files(studio.library.folder)
    slow = [clients.open_socket(studio.server.url) for _ in range(20)]
    for client in slow:
        client.sendall(f"{head}Content-Length: 100\r\n\r\n".encode() + b"x" * 10)
    chance = random.Random(0)
    parts = [
        "..",
        "/",
        "\\",
        "%2e%2e",
        "%2f",
        "%00",
        "a",
        "scenes",
        name,
        "site",
        "made",
        "uploads",
    ]
    for _ in range(300):
        path = "".join(chance.choices(parts, k=chance.randrange(1, 8)))
        method = chance.choice(["GET", "PUT", "POST"])
        with contextlib.suppress(ConnectionError):
            status, _ = studio.ask(
                f"scenes/{name}/uploads?size=1&modified=7000&start=0&path={path}", "PUT", b"x"
            )
            assert status in (200, 400, 409), path
            assert studio.ask(path, method, None if method == "GET" else b"{}")[0] < 500, path
    assert studio.ask("scenes")[0] == 200
    for client in slow:
        client.close()
    assert files(tmp_path) - files(studio.library.folder) == outside
    assert not job._started
