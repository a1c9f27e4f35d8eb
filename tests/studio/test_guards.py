"""What must not happen at the same time, and scenes that are shown in levels of detail."""

import threading
import time

import numpy as np
import pytest

from snowsplat.formats import read_gaussians
from snowsplat.formats.sog import read_sog
from snowsplat.pipeline import publish
from snowsplat.project.site_folder import SiteFolder
from snowsplat.studio import job

from .conftest import N, edit_of

KEYS = [[0.0, 1.0, -9.0, 0.0, 0.0, 0.0, 40.0, 1.5], [3.0, 2.0, -8.0, 0.0, 0.5, 0.0, 40.0, 1.5]]

pytestmark = pytest.mark.usefixtures("in_process")


def test_an_edit_waits_until_the_film_has_read_the_scene(studio, finished, monkeypatch):
    """Otherwise its cameras would be those of the scene before, its Gaussians of that after."""
    running = {"film"}
    monkeypatch.setattr(job, "is_running", lambda scene, task="make": task in running)
    original = finished.scene_file()
    finished.write_state({"process": 1}, "film")  # it has begun
    answers = []
    address = f"scenes/{finished.name}/edit"
    changes = edit_of(np.arange(N) < 20, scale=2.0)
    edit = threading.Thread(target=lambda: answers.append(studio.ask(address, "POST", changes)))
    edit.start()
    time.sleep(0.3)
    assert not answers
    assert finished.scene_file() == original
    finished.write_state({"now": {"stage": "video"}}, "film")
    edit.join(60)
    assert answers == [(200, {"file": "box_edited.ply"})]
    assert studio.ask(address, "DELETE")[0] == 200  # while the film is rendered


def test_a_page_that_shows_the_scene_before_an_edit(studio, finished, monkeypatch):
    """Its keys are in another frame, and its annotations would replace those of the other page."""
    address = f"scenes/{finished.name}"
    page = studio.ask(f"{address}/site/index.html")[1].decode()
    version = page.split('data-version="')[1].split('"')[0]
    changes = edit_of(np.zeros(N, bool), turn=[0.0, 1.0, 0.0, 0.0])
    assert studio.ask(f"{address}/edit?version={version}", "POST", changes)[0] == 200
    monkeypatch.setattr(job, "start", lambda *_: pytest.fail("a film was started"))
    for path, body in (("film", {"keys": KEYS}), ("film/path", {"keys": KEYS}), ("edit", changes)):
        status, answer = studio.ask(f"{address}/{path}?version={version}", "POST", body)
        assert (status, "open this page anew" in answer["error"]) == (400, True)
    assert studio.ask(f"{address}/edit?version={version}", "DELETE")[0] == 400
    assert not finished.plan.exists()


def test_levels_of_detail_are_edited_in_a_page_of_their_own(studio, finished, monkeypatch):
    monkeypatch.setattr(publish, "_LARGE", N - 100)
    address = f"scenes/{finished.name}"
    assert studio.ask(f"{address}/rename", "POST", {"title": "Large"})[0] == 200
    assert b'data-page="levels"' in studio.ask(f"{address}/site/index.html")[1]
    assert studio.ask(f"{address}/whole/index.html")[0] == 404
    assert studio.ask(f"{address}/whole", "POST", {}) == (200, {})
    assert b'data-page="whole"' in studio.ask(f"{address}/whole/index.html")[1]
    shown = read_sog(SiteFolder(finished.whole).scene())
    assert shown.sh_rest.shape[1] == 0
    written = (finished.whole / "index.html").stat().st_mtime_ns
    assert studio.ask(f"{address}/whole", "POST", {}) == (200, {})
    assert (finished.whole / "index.html").stat().st_mtime_ns == written  # it was there
    left = shown.means[:, 0] > 0
    # In another window; the open page can still be saved.
    assert studio.ask(f"{address}/rename", "POST", {"title": "Larger"})[0] == 200
    assert studio.ask(f"{address}/edit", "POST", edit_of(left))[0] == 200
    kept = read_gaussians(finished.scene_file())
    assert (len(kept), kept.sh_rest.shape[1]) == (N - left.sum(), 3)
    assert not finished.whole.exists()
    # Enough was removed: the site is one file.
    assert b'data-page="small"' in studio.ask(f"{address}/site/index.html")[1]
