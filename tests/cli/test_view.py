"""`snowsplat view`: finds the scene, prints the address of the page, ends on Ctrl-C."""

import json
import shutil
import signal
import socket
import threading
import urllib.request
import webbrowser
from collections.abc import Sequence
from pathlib import Path

import pytest

from snowsplat.cli import pages
from snowsplat.cli.main import main
from snowsplat.cli.pages import for_other_computers, opener_of
from snowsplat.evaluation.verdict import Reason, Verdict
from snowsplat.formats import read_gaussians, write_gaussians
from snowsplat.project.site_folder import SiteFolder
from snowsplat.util.messages import message


@pytest.fixture(scope="module")
def out(dataset, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("view") / "out"
    flags = ["--iterations", "60", "--save-iterations", "30", "--quiet"]
    assert main(["train", str(dataset), "-o", str(folder), *flags]) == 0
    return folder


def scene(out: Path) -> Path:
    return out / "point_cloud/iteration_60/point_cloud.ply"


def address(line: str) -> str:
    """The URL in the line about it."""
    told, _, url = line.strip().partition(": ")
    assert told == "open this in a browser, Ctrl-C ends it"
    assert url.startswith("http://127.0.0.1:")
    return url


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_serves_until_a_signal(start, out, number):
    process = start("view", out, "--no-browser")
    assert str(scene(out)) in process.stdout.readline()
    url = address(process.stdout.readline())
    with urllib.request.urlopen(url, timeout=10) as page:
        assert b"<title>out - snowsplat</title>" in page.read()
    with urllib.request.urlopen(f"{url}scene.compressed.ply", timeout=10) as content:
        assert content.read(4) == b"ply\n"
    process.send_signal(number)
    assert process.wait(10) == 0
    assert process.stderr.read() == ""


@pytest.fixture
def served(run, monkeypatch):
    """Run `view` until it waits: its result, the opened addresses, the scene and its title."""
    from snowsplat.pipeline import publish
    from snowsplat.pipeline.output.scene_source import ViewableScene

    site, ready = publish.site, ViewableScene.ready

    def served(*arguments: object, environment: Sequence[str] = ()):
        for name in ("SSH_CONNECTION", "SSH_TTY", "DISPLAY", "WAYLAND_DISPLAY"):
            monkeypatch.delenv(name, raising=False)
        for name in environment:
            monkeypatch.setenv(name, ":0")
        opened, shown, done = [], [], threading.Event()
        monkeypatch.setattr(webbrowser, "open", lambda url: (opened.append(url), done.set()))
        monkeypatch.setattr(publish, "site", lambda *a, **k: (shown.append(a[0]), site(*a, **k))[1])
        monkeypatch.setattr(
            ViewableScene, "ready", lambda self: (shown.append(self), ready(self))[1]
        )
        monkeypatch.setattr(pages, "wait", lambda: done.wait(0.3))
        result = run("view", *arguments)
        assert result.code == 0, result.err
        return result, opened, shown[:2]

    return served


def test_opens_a_browser_if_there_is_a_display(served, out):
    result, opened, _ = served(out, environment=["DISPLAY"])
    url = address(result.out.splitlines()[1])
    # All users of the computer see the command line of a browser.
    opener = opener_of(url)
    assert opened == [opener.as_uri()]
    assert url.split("/")[3] not in opened[0]
    assert f'content="0; url={url}"' in opener.read_text()
    assert {path.stat().st_mode & 0o77 for path in (opener, opener.parent)} == {0}
    assert served(out, "--no-browser", environment=["DISPLAY"])[1] == []
    assert served(out)[1] == []


def test_over_ssh_it_prints_the_port_forwarding_command(served, out):
    result, opened, _ = served(out, environment=["SSH_CONNECTION"])
    port = address(result.out.splitlines()[1]).split(":")[2].split("/")[0]
    assert f"ssh -L {port}:127.0.0.1:{port} " in result.out
    assert not opened
    assert "ssh" not in served(out)[0].out


def test_a_user_without_a_name_can_forward_a_port(monkeypatch):
    """In a container, a user may have a number only."""

    def unknown() -> str:
        raise KeyError("getpwuid(): uid not found: 4242")

    monkeypatch.setattr("getpass.getuser", unknown)
    monkeypatch.setenv("SSH_CONNECTION", "1")
    (line,) = for_other_computers("http://127.0.0.1:81/", [])
    assert str(line).startswith("from your computer: ssh -L 81:127.0.0.1:81 USER@")


def test_with_a_public_host_it_prints_the_address_for_other_computers(served, out):
    here, others = served(out, "--host", "0.0.0.0", "--no-browser")[0].out.splitlines()[1:]
    assert others.endswith(address(here).replace("127.0.0.1", socket.gethostname()))


def test_which_scene_and_which_cameras(served, out, tmp_path):
    _, _, (scene_30, about) = served(out, "--iteration", 30)
    assert about.title == "out"
    assert about.made is not None
    thirty = read_gaussians(out / "point_cloud/iteration_30/point_cloud.ply")
    assert scene_30.gaussians.means.equal(thirty.means)
    assert len(scene_30.cameras) == 9
    assert scene_30.background == (0.0, 0.0, 0.0)
    assert (
        len(served(scene(out))[2][0].cameras) == 9
    )  # the output folder is found from the scene file
    shutil.copy(scene(out), tmp_path / "garden.ply")
    assert served(tmp_path / "garden.ply")[2][0].cameras == []
    # The output of `snowsplat make`: OUT/garden.ply is a copy of the scene in OUT/scene, and the
    # record names it.
    shutil.copytree(out, tmp_path / "scene")
    assert served(tmp_path / "garden.ply")[2][0].cameras == []
    (tmp_path / "make.json").write_text('{"file": "garden.ply"}')
    assert len(served(tmp_path / "garden.ply")[2][0].cameras) == 9
    shown, made = served(tmp_path)[2]
    assert (len(shown.cameras), about.grade, made.grade) == (9, "", "")
    verdict = Verdict.of([Reason("usable", message("few photos"))]).as_json()
    record = {"file": "garden.ply", "stages": {"scene": {"result": {"verdict": verdict}}}}
    (tmp_path / "make.json").write_text(json.dumps(record))
    assert served(tmp_path)[2][1].grade == "usable"
    shutil.copy(out / "point_cloud/iteration_30/point_cloud.ply", tmp_path / "other.ply")
    assert served(tmp_path / "other.ply")[2][0].cameras == []


@pytest.mark.parametrize("levels", [False, True])
def test_a_published_site_is_served_as_it_is(start, out, tmp_path, monkeypatch, levels):
    from snowsplat.pipeline import publish

    monkeypatch.setattr(publish, "_LARGE", 10 if levels else 10**9)
    site = tmp_path / "site"
    publish.publish(out, site, publish.PublishOptions(title="My garden"))
    process = start("view", site, "--no-browser")
    assert process.stdout.readline() == f"{site / 'index.html'}: a web site\n"
    url = address(process.stdout.readline())
    content = SiteFolder(site).content()
    assert content.name == ("lod-meta.json" if levels else "scene.sog")
    loaded = [content.with_name(name) for name in ("index.js", "poster.jpg", content.name)]
    for path in (site / "index.html", *loaded):
        file = path.relative_to(site).as_posix()
        with urllib.request.urlopen(url + file, timeout=10) as response:
            assert response.read() == (site / file).read_bytes()
    with urllib.request.urlopen(url, timeout=10) as page:
        assert b"<title>My garden" in page.read()
        assert page.headers["Content-Type"] == "text/html; charset=utf-8"
    process.send_signal(signal.SIGINT)
    assert process.wait(10) == 0


def test_errors(refused, out, tmp_path):
    assert "needs a scene" in refused("view")
    assert "no such file" in refused("view", tmp_path / "absent")
    assert "contains no scene" in refused("view", tmp_path)
    assert "leave it out" in refused("view", scene(out), "--iteration", 3)
    write_gaussians(tmp_path / "empty.ply", read_gaussians(scene(out)).map(lambda t: t[:0]))
    assert "contains no Gaussians" in refused("view", tmp_path / "empty.ply")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert f"--port: {port} is in use" in refused("view", out, "--port", port)
