"""Editing in the page of a finished scene: what is selected, and what the studio stores."""

import json

import numpy as np
import pytest
import torch

from snowsplat.formats import read_gaussians
from snowsplat.formats.sog import read_sog
from snowsplat.project.site_folder import SiteFolder
from snowsplat.util.files import write_json

from ..browser import Browser, Page
from .conftest import N, edit_of, of_the_command_line, press


@pytest.mark.usefixtures("in_process")
def test_an_edit_is_stored_shown_and_taken_back(studio, finished):
    address = f"scenes/{finished.name}"
    original = (finished.made / "box.ply").read_bytes()
    plan = {"keys": [[0.0, 0, -9, 0, 0, 0, 40, 1.5], [1.0, 0, -9, 0, 0, 0, 40, 1.5]]}
    write_json(finished.plan, plan)
    changes = edit_of(np.arange(N) < 20, title=" Half\n a box ", scale=2.0)
    assert studio.ask(f"{address}/edit", "POST", changes) == (200, {"file": "box_edited.ply"})
    about = studio.ask(address)[1]
    assert (about["title"], about["edited"] > 0) == ("Half a box", True)
    assert about["state"]["result"]["gaussians"] == N - 20
    assert "box_edited.ply" in about["exports"]["spz"]
    assert "box_edited.ply" in about["exports"]["zip"]
    assert studio.ask(f"{address}/exports/ply", "POST", {})[0] == 200
    assert len(read_gaussians(finished.exports / "Half a box.ply")) == N - 20
    assert (finished.made / "box.ply").read_bytes() == original
    keys = json.loads(finished.plan.read_text())["keys"]
    assert np.allclose(keys[1][:3], [2, 0, -18])  # of the larger scene
    assert studio.ask(f"{address}/edit", "DELETE") == (200, {"file": "box.ply"})
    about = studio.ask(address)[1]
    assert (about["edited"], about["state"]["result"]["gaussians"]) == (0, N)
    assert len(read_sog(SiteFolder(finished.site).scene()).means) == N
    assert not finished.exports.exists()  # they were those of the edited scene
    assert studio.ask(f"{address}/edit", "DELETE")[0] == 400


@pytest.mark.usefixtures("in_process")
def test_a_scene_is_renamed_and_removed(studio, finished):
    address = f"scenes/{finished.name}"
    assert studio.ask("scenes")[1][0]["picture"]
    assert studio.ask(f"{address}/picture")[1].startswith(b"\xff\xd8")
    for title in ("", " \n", None, 7):
        assert studio.ask(f"{address}/rename", "POST", {"title": title})[0] == 400
    assert studio.ask(f"{address}/rename", "POST", {"title": "My\nbox"}) == (200, {})
    assert studio.ask(address)[1]["title"] == "My box"
    assert "<title>My box</title>" in (finished.site / "index.html").read_text("utf-8")
    assert studio.ask(address, "DELETE") == (200, {"photos": None})
    assert studio.ask(address)[0] == 404
    assert studio.ask("scenes") == (200, [])


@pytest.mark.usefixtures("in_process")
def test_a_scene_of_the_command_line_is_opened_edited_and_handed_on(studio):
    file = of_the_command_line(studio.library.folder / "tour")
    write_json(file.parents[2] / "metrics.json", {"split": "test", "psnr": 27.5})
    address = "scenes/tour"
    assert studio.ask(address)[1]["status"] == "found"
    assert studio.ask(f"{address}/open", "POST", {}) == (200, {"file": "point_cloud.ply"})
    about = studio.ask(address)[1]
    assert (about["status"], about["found"]) == ("done", True)
    assert (about["state"]["result"]["gaussians"], about["state"]["result"]["psnr"]) == (50, 27.5)
    assert studio.ask(f"{address}/open", "POST", {}) == (200, {})  # it is there
    changes = edit_of(np.arange(50) < 20)
    assert studio.ask(f"{address}/edit", "POST", changes) == (
        200,
        {"file": f"{file.stem}_edited.ply"},
    )
    assert studio.ask(f"{address}/exports/spz", "POST", {})[0] == 200
    assert len(read_gaussians(file.parents[2] / "studio/exports/tour.spz")) == 30
    # The training goes on: the page is that of another scene.
    of_the_command_line(studio.library.folder / "tour", 7)
    assert studio.ask(address)[1]["status"] == "found"
    assert studio.ask(f"{address}/start", "POST", {})[0] == 400
    assert (
        studio.ask(f"{address}/uploads?path=a&size=1&modified=7000&start=0", "PUT", b"x")[0] == 400
    )
    assert studio.ask(address, "DELETE")[0] == 400
    assert file.is_file()


@pytest.mark.usefixtures("in_process")
def test_hostile_changes(studio, finished):
    address = f"scenes/{finished.name}/edit"
    nothing = np.zeros(N, bool)
    bad = [
        {},
        edit_of(nothing[:-8]) | {"count": N},
        edit_of(nothing) | {"count": 10**18},
        edit_of(nothing) | {"count": True},
        edit_of(nothing) | {"removed": "é" * 52},
        edit_of(nothing) | {"removed": None},
        edit_of(nothing, scale="2"),
        edit_of(nothing, scale=-1),
        edit_of(nothing, start=[1, 2, 3]),
        edit_of(nothing, title=7),
        edit_of(nothing, path="../../x"),
    ]
    for body in bad:
        status, answer = studio.ask(address, "POST", body)
        assert (status, "\n" in answer["error"]) == (400, False), body
    text = json.dumps(edit_of(nothing, scale=1.0)).replace("1.0", "1e999")
    assert studio.ask(address, "POST", text)[0] == 400
    assert studio.ask(address, "POST", b"[" * 100_000)[0] == 400
    assert studio.ask(address, "POST", b"\xff")[0] == 400
    # The number of another page, and all of it, are only known where the scene is read.
    assert studio.ask(address, "POST", edit_of(nothing[:-1]))[0] == 400
    assert studio.ask(address, "POST", edit_of(~nothing))[0] == 400
    assert [file.name for file in finished.made.iterdir()] == ["box.ply"]


def test_a_site_has_no_tools_but_its_page_in_the_studio_has(studio, finished):
    page = studio.ask(f"scenes/{finished.name}/site/index.html")[1].decode()
    assert 'src="../../../tools.js" data-page="small" data-edited="false"' in page
    assert "tools.js" not in (finished.site / "index.html").read_text("utf-8")
    # Levels of detail are edited in another page.
    SiteFolder(finished.site).scene().unlink()
    page = studio.ask(f"scenes/{finished.name}/site/index.html")[1].decode()
    assert 'data-page="levels"' in page


def counts(page: Page) -> str:
    return page.evaluate("document.querySelector('.snow-edit > p').textContent")


@pytest.mark.browser
def test_lasso_delete_undo_delete_save(studio, forked, finished):
    """The saved file has exactly the others."""
    address = f"{studio.server.url}scenes/{finished.name}/site/index.html"
    with Browser(900, 600, frames=4.0) as browser:
        page = browser.open(address, timeout=60)
        page.wait_for("!!document.querySelector('.snow-edit')", 120)
        left, right = np.s_[370:430, 150:400], np.s_[200:450, 580:670]
        before = page.wait_for_picture(lambda shown: shown[left].mean() > 2)
        press(page, "Edit")
        press(page, "Lasso")
        page._mouse("mousePressed", 690, 100, button="left", clickCount=1)
        for x, y in ((890, 100), (890, 590), (690, 590)):
            page._mouse("mouseMoved", x, y, button="left", buttons=1)
        page._mouse("mouseReleased", 690, 590, button="left", clickCount=1)
        page.wait_for("!document.querySelector('.snow-edit > p').textContent.startsWith('0 ')")
        selected = int(counts(page).split()[0])
        assert 20 < selected < N - 20
        press(page, "Delete")
        assert counts(page) == f"0 Gaussians selected, {selected} deleted"
        page.key("z", 2)
        assert counts(page) == f"{selected} Gaussians selected, 0 deleted"
        page.key("Delete")
        assert counts(page) == f"0 Gaussians selected, {selected} deleted"
        # The same without a mouse: the arrow keys move a cross, Enter presses and releases it.
        press(page, "Rectangle")
        for way in ("Up", "Left", "Down", "Right"):
            for _ in range(3 if way in ("Up", "Left") else 6):
                page.key(f"Arrow{way}", 8)
            if way in ("Left", "Right"):
                page.key("Enter")
        assert 0 < int(counts(page).split()[0]) < N - selected
        page.key("Escape")
        # A turn is seen, and undone exactly.
        pose = (
            "JSON.stringify([...sse.viewer.app.root.findByName('gsplat').getWorldTransform().data])"
        )
        straight = page.evaluate(pose)
        press(page, "Level and turn")
        press(page, "+90°")
        assert page.evaluate(pose) != straight
        press(page, "Undo")
        assert page.evaluate(pose) == straight
        press(page, "Start with this view")
        page.evaluate("window.old = true")
        press(page, "Save")
        page.wait_for("!window.old && !!document.querySelector('.snow-edit')", 180)
        press(page, "Edit")
        assert "Back to the original" in page.evaluate(
            "document.querySelector('.snow-edit').textContent"
        )
        press(page, "Edit")  # the scene has the whole window
        # What was in the lasso is gone; from the same place, the rest looks as before.
        after = page.wait_for_picture(
            lambda shown: np.abs(before[left].astype(float) - shown[left]).mean() < 2
        )
        assert before[right].mean() > 5 * after[right].mean()
        assert not page.errors
    whole, kept = read_gaussians(finished.made / "box.ply"), read_gaussians(finished.scene_file())
    assert len(kept) == N - selected
    rows = [int((whole.means == mean).all(1).nonzero()[0]) for mean in kept.means]
    gone = torch.ones(N, dtype=torch.bool)
    gone[rows] = False
    # The right side of the page: the centres of those that are gone are all on one side.
    x = whole.means[:, 0]
    assert x[gone].min() > x[~gone].max() - 0.05 or x[gone].max() < x[~gone].min() + 0.05
