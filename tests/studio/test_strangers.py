"""A folder of a stranger in the library: its pages get neither the origin nor the token."""

import http.client
import json
import re

import pytest
from tests.studio.conftest import of_the_command_line

from snowsplat.project.site_folder import SiteFolder
from snowsplat.project.studio_scene import StudioScene
from snowsplat.studio import job
from snowsplat.viewer.web.viewer_page import asset

from ..browser import Browser

EVIL = "<script>document.title = 'evil ' + location.href</script>"
SCRIPTS = (
    "<html><head><meta name='referrer' content='unsafe-url'>"
    "<meta http-equiv='refresh' content='9; url=http://evil.example'></head>"
    f"<body>{EVIL}<img src=x onerror=alert(1)></body></html>"
)


@pytest.fixture
def strange(library) -> StudioScene:
    """A training, and what `publish` and the studio would have written, by a stranger."""
    folder = library.folder / "tour"
    of_the_command_line(folder)
    site = folder / "studio/site"
    site.mkdir(parents=True)
    for name in ("evil.html", "evil.svg", "evil.js", "index.js", "evil.xhtml", "evil"):
        (site / name).write_text(SCRIPTS)
    (site / "scene.sog").write_bytes(b"scene")
    (site / "index.html").write_text(SCRIPTS)
    (folder / "report.html").write_text(SCRIPTS)
    (folder / "evil.js").write_text(EVIL)
    (folder / "studio/map.svg").write_text(f"<svg>{EVIL}</svg>")
    (folder / "studio/film.mp4").write_text(SCRIPTS)
    shown = ['"><script>alert(1)</script>', "tour"]
    result = {"reports": {"training": "report.html"}, "shown": shown, "gaussians": 1, "bytes": 1}
    state = {"outcome": "done", "result": result, "page": "http://evil.example/"}
    (folder / "studio/state.json").write_text(json.dumps(state))
    return StudioScene(folder)


def raw(studio, path: str, method: str = "GET", **headers: str):
    """Status, headers and body of a request whose path has its token."""
    connection = http.client.HTTPConnection("127.0.0.1", studio.server.port, timeout=30)
    connection.request(method, path, headers=headers)
    response = connection.getresponse()
    body = response.read().decode("latin-1")
    connection.close()
    return response.status, response.headers, body


def test_nothing_of_the_folder_is_a_page(studio, strange):
    begin = f"/{studio.server.token}/scenes/tour"
    for path in (
        *(f"site/{name}" for name in ("evil.html", "evil.svg", "evil.js", "evil.xhtml", "evil")),
        *("site/scene.sog", "film/file"),
    ):
        status, headers, _ = raw(studio, f"{begin}/{path}")
        assert status == 200
        assert headers["Content-Type"] in ("application/octet-stream", "video/mp4")
        assert headers["Content-Security-Policy"] == "sandbox; default-src 'none'"
        assert headers["X-Content-Type-Options"] == "nosniff"
    headers = raw(studio, f"{begin}/map")[1]
    assert headers["Content-Security-Policy"].startswith("sandbox; default-src 'none';")
    assert headers["Content-Disposition"] == "attachment"
    # The scripts of the viewer are those of this program.
    assert studio.ask("scenes/tour/site/index.js")[1].decode() == asset("index.js")
    assert studio.ask("scenes/tour/site/index.html")[0] == 404  # it is no page of a scene
    for path in ("made/report.html", "made/evil.js"):
        assert studio.ask(f"scenes/tour/{path}")[0] == 404


def test_the_page_of_a_scene_has_only_its_values(studio, strange):
    panel = {"title": "</title><script>alert(1)</script>"}
    values = json.dumps({"contentUrl": "./scene.sog", "panel": panel}).replace("<", "\\u003c")
    slot = f'<script type="application/json" id="sse-bootstrap">{values}</script>'
    (strange.site / "index.html").write_text(SCRIPTS.replace("<body>", f"<body>{slot}"))
    begin = f"/{studio.server.token}/scenes/tour/site/index.html"
    status, headers, page = raw(studio, begin)
    assert status == 200
    assert "evil" not in page
    assert "alert(1)</script>" not in page
    assert "refresh" not in page
    assert "./scene.sog" in page
    policy = headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert not re.search(r"script-src[^;]*'unsafe-inline'", policy)
    assert 'data-version="&quot;&gt;&lt;script&gt;' in page


def test_the_live_page_is_that_of_the_program(studio, strange, monkeypatch):
    status, headers, page = raw(studio, f"/{studio.server.token}/scenes/tour/live/")
    assert (status, "<title>snowsplat</title>" in page) == (200, True)
    assert headers["Content-Security-Policy"].startswith("default-src 'none'; script-src 'self'")
    assert studio.ask("scenes/tour/live/../state.json")[0] == 404


def test_a_token_that_only_reads_one_thing(studio, strange, finished):
    told = studio.ask("scenes/tour")[1]
    look = told["made"].split("/")[1]
    status, headers, _ = raw(studio, f"/{look}/scenes/tour/made/report.html")
    assert status == 200
    policy = headers["Content-Security-Policy"]
    assert policy.startswith("sandbox allow-scripts; default-src 'none';")
    assert "same-origin" not in policy
    url = studio.ask("about?path=scenes/Box/site/index.html")[1]["addresses"][0]["url"]
    site = url.split("/")[3]
    status, _, page = raw(studio, f"/{site}/scenes/Box/site/index.html")
    assert (status, "tools.js" in page) == (200, False)
    content = SiteFolder(finished.site).scene().relative_to(finished.site)
    assert raw(studio, f"/{site}/scenes/Box/site/{content.as_posix()}", "HEAD")[0] == 200
    assert studio.server.token not in url + told["made"]
    full = studio.server.token
    upgrade = {"Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13"}
    key = {"Sec-WebSocket-Key": 22 * "A" + "=="}
    tries = [
        ("GET", f"/{token}/{path}", {})
        for token in (look, site)
        for path in (
            *("", "about", "scenes", "browse?path=/", "studio.js", "scenes/tour", "scenes/Box"),
            *("scenes/Box/photos", "scenes/Box/made/box.ply", "scenes/Box/exports/ply"),
            *("scenes/tour/site/scene.sog", "scenes/tour/film", "scenes/tour/map"),
            *("scenes/tour/made/../studio/state.json", "scenes/tour/made/evil.js"),
            *("scenes/tour/made/%2e%2e%2f%2e%2e%2fBox/job.json", "scenes/tour/made"),
            *("scenes/Box/site/../made/box.ply", "scenes/Box/site/..%2fjob.json"),
            *("scenes%2fBox%2fmade%2fbox.ply", "scenes//Box/site/index.html"),
        )
    ]
    tries += [
        (method, f"/{site}/scenes/Box/{path}", {})
        for method in ("POST", "PUT", "DELETE", "PATCH", "OPTIONS")
        for path in ("", "site/index.html", "start", "edit", "uploads", "exports/ply")
    ]
    tries += [("GET", f"/{site}/scenes/Box/live/live", {**upgrade, **key})]
    tries += [("GET", f"/{site[:-1]}/scenes/Box/site/index.html", {})]
    for method, path, headers in tries:
        assert raw(studio, path, method, **headers)[0] in (400, 404), (method, path)
    assert raw(studio, f"/{full}/scenes/Box")[0] == 200
    empty = studio.server._guard.look("")
    assert raw(studio, f"/{empty}")[1]["Location"] == f"{empty}/"


def test_a_job_that_does_not_run_has_no_live_images(studio, strange, monkeypatch):
    """The folder names a page elsewhere."""
    from websockets.exceptions import ConnectionClosedOK
    from websockets.sync.client import connect

    from snowsplat.studio import result_requests

    monkeypatch.setattr(result_requests, "relay_socket", lambda *_: pytest.fail("was asked"))
    live = f"{studio.server.url.replace('http', 'ws', 1)}scenes/tour/live/live"
    for running in (False, True):
        monkeypatch.setattr(job, "is_running", lambda *_, running=running: running)
        with connect(live) as socket, pytest.raises(ConnectionClosedOK):
            socket.recv()


def test_a_report_in_a_browser(studio, strange):
    """Its script runs, so that people can change the language; it sees no secret of the studio."""
    with Browser(320, 240) as browser:
        studio_page = browser.open(studio.server.url)
        studio_page.wait_for("!!document.querySelector('.drop')")
        look = studio.ask("scenes/tour")[1]["made"]
        studio_page.evaluate(f"location.href = '{look}report.html'")
        studio_page.wait_for("document.title.startsWith('evil')")
        seen = studio_page.evaluate("document.title + document.referrer + self.origin")
        assert studio.server.token not in seen
        assert seen.endswith("null")
