"""A film of a finished scene: planned in its page, rendered by a process of its own."""

import json
import math
import shutil
import subprocess
import time
from pathlib import Path

import av
import pytest

from snowsplat.project import page_film
from snowsplat.studio import job, worker

from ..browser import Browser
from .conftest import of_the_command_line, press

KEYS = [[0.0, 1.0, -9.0, 0.0, 0.0, 0.0, 40.0, 1.5], [3.0, 2.0, -8.0, 0.0, 0.5, 0.0, 40.0, 1.5]]


def test_a_film_is_rendered_and_sent(studio, monkeypatch):
    of_the_command_line(studio.library.folder / "tour")
    assert studio.ask("scenes/tour/open", "POST", {})[0] == 200
    address = "scenes/tour/film"
    before = studio.ask(address)[1]
    assert (before["running"], before["plan"], before["bytes"]) == (False, None, 0)
    assert studio.ask(f"{address}/file")[0] == 404
    for wrong in ({}, {"keys": KEYS[:1]}, {"keys": KEYS, "size": "9x9"}, {"keys": KEYS, "x": 1}):
        for path in (address, f"{address}/path"):
            status, answer = studio.ask(path, "POST", wrong)
            assert (status, "\n" in answer["error"]) == (400, False)
    plan = {"keys": KEYS, "seconds": 0.1, "size": "64x36", "ease": True, "loop": False}
    plan["speeds"] = [0.5, 1.0]
    monkeypatch.setattr(page_film, "SIZES", ("64x36",))
    started = []
    monkeypatch.setattr(job, "start", lambda scene, task: started.append((scene.name, task)))
    assert studio.ask(address, "POST", plan) == (200, {})
    assert started == [("tour", "film")]
    scene = studio.library.find("tour")
    assert worker.run_job(scene, "film") == 0
    about = studio.ask(address)[1]
    assert (about["running"], about["outcome"], about["plan"]) == (False, "done", plan)
    assert about["command"].endswith("--seconds 0.1 --ease --size 64x36 --video film.mp4")
    status, film = studio.ask(f"{address}/file")
    assert (status, len(film)) == (200, about["bytes"])
    with av.open(str(scene.film)) as video:
        assert len(list(video.decode(video=0))) == 3
    assert studio.ask("scenes/tour")[1]["film"] > 0


def test_a_film_is_stopped(studio, holder):
    of_the_command_line(studio.library.folder / "tour")
    scene = studio.library.find("tour")
    scene.site.mkdir(parents=True)
    address = "scenes/tour/film"
    assert studio.ask(address, "POST", {"keys": KEYS}) == (200, {})
    assert studio.ask(address)[1]["running"]
    assert studio.ask(address, "POST", {"keys": KEYS})[0] == 400
    while "process" not in scene.state("film"):
        time.sleep(0.05)
    assert not job.is_running(scene)  # another task
    assert studio.ask(address, "DELETE") == (200, {})
    while studio.ask(address)[1]["running"]:
        time.sleep(0.05)
    assert studio.ask(address)[1]["outcome"] == "stopped"


@pytest.mark.skipif(shutil.which("node") is None, reason="needs node")
def test_a_turn_is_level_and_keeps_its_distance():
    pages = Path(worker.__file__).parent / "pages"
    module = (pages / "film.js").as_uri()
    script = f"""import {{ around, cameraAt, turnOver }} from {json.dumps(module)};
        const view = [3, 2, 4, 0, 1, 0, 40, 1.5];
        const turn = around(view, turnOver(view, [], 4));
        const side = [[4, 2, -3], [5, 2, 0], [3, 2, 4]];
        const swing = around(view, turnOver(view, side, 4));
        const ring = turnOver(view, [...side, [-3, 2, -4], [-4, 2, 3]], 4);
        const between = cameraAt([[0, 0], [2, 4], [4, 0]], 0.75);
        console.log(JSON.stringify([turn, between, swing, ring]));"""
    command = ["node", "--input-type=module", "-e", script]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    turn, between, swing, ring = json.loads(done.stdout)
    assert between == [3, 2]
    expected = [[3, 4], [4, -3], [-3, -4], [-4, 3]]
    assert [[round(key[0], 9), round(key[2], 9)] for key in turn] == expected
    assert {(key[1], *key[3:]) for key in turn} == {(2, 0, 1, 0, 40, 1.5)}
    # Photos of one side: there and back over it. Photos all round: all round.
    half = 5 / math.sqrt(50)
    places = [[3, 4], [7 * half, half], [4, -3], [7 * half, half]]
    for key, place in zip(swing, places, strict=True):
        assert [key[0], key[2]] == pytest.approx(place)
    assert ring == pytest.approx([0, math.pi / 2, math.pi, 3 * math.pi / 2])


@pytest.mark.browser
def test_a_turn_in_the_page(studio, forked):
    """Its keys, the preview, and what is sent to the studio."""
    of_the_command_line(studio.library.folder / "tour")
    assert studio.ask("scenes/tour/open", "POST", {})[0] == 200
    with Browser(900, 600, frames=4.0) as browser:
        page = browser.open(f"{studio.server.url}scenes/tour/site/index.html", timeout=60)
        page.wait_for("!!document.querySelector('.snow-edit')", 120)
        # Copied links only show the scene.
        look = studio.server._guard.look("scenes/tour/site/index.html")
        page.wait_for(f"window.sse.look?.includes('/{look}/scenes/tour/site/index.html')")
        press(page, "Film")
        press(page, "360° turn")
        assert page.evaluate("document.querySelectorAll('.snow-keys button').length") == 8
        # Another tool closes the film: a preview that is still prepared does not begin.
        press(page, "Preview")
        press(page, "Edit")
        assert page.evaluate("document.querySelector('.snow-film').hidden")
        page.wait_for("document.querySelector('.snow-film [role=status]').textContent === ''", 60)
        assert page.evaluate("document.querySelector('.snow-frame').hidden")
        press(page, "Film")
        assert page.evaluate("document.querySelector('.snow-edit').hidden")
        press(page, "Preview")
        page.wait_for("!document.querySelector('.snow-frame').hidden", 60)
        entity = "window.sse.viewer.app.root.findByName('camera').getPosition()"
        scrub = "(() => { const slider = document.querySelector('.snow-film input[type=range]');"
        page.evaluate(
            f"{scrub} slider.value = 0.5; slider.dispatchEvent(new Event('input')); }})()"
        )
        keys = json.loads(studio.library.find("tour").plan.read_text())["keys"]
        (x, _, z, *_), opposite = keys[0], keys[4]
        far = math.hypot(x - opposite[0], z - opposite[2])
        assert far > 1
        # The last frame is before the first view, so half of the time is not half of the way.
        left = f"Math.hypot({entity}.x - {opposite[0]}, {entity}.z - {opposite[2]})"
        page.wait_for(f"{left} < {0.05 * far}", 30)
        assert not page.errors
