"""An edit whose process was killed: nothing of it is half done, and two never work at once."""

import os
import threading
import zipfile
from dataclasses import asdict

import numpy as np
import pytest

from snowsplat.formats import read_gaussians
from snowsplat.formats.sog import read_sog
from snowsplat.project.page_film import PageFilm
from snowsplat.project.site_folder import SiteFolder
from snowsplat.studio import changes, job
from snowsplat.util.errors import UserError
from snowsplat.util.files import write_json
from snowsplat.util.run_lock import locked, one_run
from snowsplat.util.safe_json import from_json, read_json

from .conftest import N, edit_of

pytestmark = pytest.mark.usefixtures("in_process")

NOTHING = np.zeros(N, bool)
KEYS = [[0.0, 0, -9, 0, 0, 0, 40, 1.5], [1.0, 0, -9, 0, 0, 0, 40, 1.5]]


class Killed(BaseException):
    pass


@pytest.mark.parametrize("before", ["edit", "finish_edit", "publish"])
def test_what_is_left_of_an_edit_is_done(studio, finished, monkeypatch, before):
    """Title, places of the film and site are those of the scene, whichever one is shown."""
    write_json(finished.plan, asdict(PageFilm(KEYS)))
    write_json(finished.edits, edit_of(np.arange(N) < 20, title="Half", scale=2.0))
    calls = []

    def killed(*_, **__):
        calls.append(before)
        # The first call of `finish_edit` is that for an earlier edit.
        if len(calls) == (2 if before == "finish_edit" else 1):
            raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(changes, before, killed)
        with pytest.raises(Killed):
            changes.edit_scene(finished, finished.version())
    is_edited = before != "edit"
    address = f"scenes/{finished.name}"
    about = studio.ask(address)[1]
    assert about["status"] == ("opening" if is_edited else "done")
    if is_edited:
        # The page shows the scene before the edit: it cannot change this one.
        page = studio.ask(f"{address}/site/index.html")[1].decode()
        version = page.split('data-version="')[1].split('"')[0]
        status, answer = studio.ask(f"{address}/edit?version={version}", "POST", edit_of(NOTHING))
        assert (status, "open this page anew" in answer["error"]) == (400, True)
        assert studio.ask("scenes")[1][0]["status"] == "done"
        assert studio.ask(f"{address}/open", "POST", {})[0] == 200
    for _ in range(2):
        about = studio.ask(address)[1]
        assert (about["status"], about["title"]) == ("done", "Half" if is_edited else "Box")
        assert len(read_sog(SiteFolder(finished.site).scene()).means) == N - 20 * is_edited
        keys = from_json(PageFilm, read_json(finished.plan)).keys
        assert np.allclose(keys[1][:3], [2, 0, -18] if is_edited else [1, 0, -9])
        changes.show_scene(finished)
    assert not finished.begun.exists()


def test_files_of_a_killed_edit_are_removed(finished):
    made = finished.scene_file().parent
    names = [".box_edited.ply.tmp", "..box_edited.ply.tmp.tmp", ".box_edited.next.json.tmp"]
    files = [finished.kept / ".edit_begun.json.tmp", *(made / name for name in names)]
    others = made / ".other_edited.ply.tmp"
    for file in (*files, others):
        file.touch()
    changes.show_scene(finished)
    assert [file.exists() for file in (*files, others)] == [False] * 4 + [True]


def test_a_failed_edit_leaves_nothing(studio, finished):
    """Neither its title nor the film of that time appear when the scene is made again."""
    write_json(finished.plan, asdict(PageFilm(KEYS)))
    write_json(finished.edits, edit_of(~NOTHING, title="Nothing", scale=2.0))
    with pytest.raises(UserError, match="nothing would be left"):
        changes.edit_scene(finished, finished.version())
    file = finished.scene_file()
    os.utime(file, ns=(1, file.stat().st_mtime_ns + 1))
    write_json(finished.plan, asdict(PageFilm(KEYS[::-1])))
    changes.show_scene(finished)
    assert finished.job.title == "Box"
    assert from_json(PageFilm, read_json(finished.plan)).keys == KEYS[::-1]


def test_a_new_title_is_newer_than_that_of_a_killed_edit(finished, monkeypatch):
    write_json(finished.edits, edit_of(np.arange(N) < 20, title="Half"))
    with monkeypatch.context() as patch:
        patch.setattr(changes, "show_scene", lambda scene: {})  # the process is killed before it
        changes.edit_scene(finished, finished.version())
    assert finished.begun.exists()
    changes.rename(finished, "Whole")
    assert finished.job.title == "Whole"
    assert not finished.begun.exists()


def test_an_edit_waits_for_one_of_a_studio_that_was_killed(studio, finished):
    address = f"scenes/{finished.name}"
    answers = []
    changes = edit_of(np.arange(N) < 20)
    with locked(finished.edit_lock, ""):
        assert studio.ask(address, "DELETE")[0] == 400
        edit = threading.Thread(
            target=lambda: answers.append(studio.ask(f"{address}/edit", "POST", changes))
        )
        edit.start()
        edit.join(0.3)
        assert answers == []
        assert finished.scene_file().name == "box.ply"
    edit.join(30)
    assert answers == [(200, {"file": "box_edited.ply"})]


def test_a_scene_that_is_made_in_a_terminal_is_left_alone(studio, finished):
    """Its edit would be that of the scene before."""
    address = f"scenes/{finished.name}"
    with one_run(finished.made):
        edit, remove = (f"{address}/edit", "POST", edit_of(NOTHING)), (address, "DELETE")
        for request in (edit, remove):
            status, answer = studio.ask(*request)
            assert (status, "is being made" in answer["error"]) == (400, True)
    assert studio.ask(f"{address}/edit", "POST", edit_of(NOTHING))[0] == 200


def test_a_file_is_that_of_the_scene_as_it_is(studio, finished):
    """Also if the scene was replaced while the file was written."""
    address = f"scenes/{finished.name}/exports/ply"
    assert studio.ask(address, "POST", {})[0] == 200
    file = finished.exports / "Box.ply"
    first = file.stat().st_ino
    assert studio.ask(address, "POST", {})[0] == 200
    assert file.stat().st_ino == first  # it was there
    changes = edit_of(np.arange(N) < 20)
    assert studio.ask(f"scenes/{finished.name}/edit", "POST", changes)[0] == 200
    finished.exports.mkdir()
    file.write_bytes((finished.made / "box.ply").read_bytes())
    assert studio.ask(address, "POST", {})[0] == 200
    assert len(read_gaussians(file)) == N - 20


def test_a_web_site_is_that_of_the_scene_as_it_is(studio, finished):
    """Here, the site was not written since the scene got its title."""
    finished.change(title="New")
    address = f"scenes/{finished.name}/exports/zip"
    assert studio.ask(address, "POST", {}) == (200, {"file": "New.zip"})
    with zipfile.ZipFile(finished.exports / "New.zip") as archive:
        assert b"<title>New</title>" in archive.read("index.html")


def test_a_folder_to_look_at(studio, finished, monkeypatch):
    """The site is not that of the scene, as after an update, and cannot be written anew: it is
    shown, and files that are there are sent."""
    address = f"scenes/{finished.name}"
    assert studio.ask(f"{address}/exports/ply", "POST", {})[0] == 200
    finished.change(title="Box ")
    assert studio.ask(address)[1]["status"] == "opening"
    monkeypatch.setattr(os, "access", lambda path, mode: mode != os.W_OK)
    assert studio.ask(address)[1]["status"] == "done"
    monkeypatch.setattr(job, "work", None)
    assert studio.ask(f"{address}/exports/ply", "POST", {}) == (200, {"file": "Box.ply"})
