"""The tools of the editor in the 3D view, by real clicks: the handles of the box, a level floor."""

import math
import time

import pytest
import torch
from tests.gaussians import gaussians_in_box

from snowsplat.formats import read_gaussians, write_gaussians
from snowsplat.pipeline.publish import publish
from snowsplat.scene.gaussians import Gaussians

from ..browser import Browser, Page
from .conftest import edit_of, press

pytestmark = pytest.mark.browser

TILT = math.radians(20)
NOTE = {"title": "Corner", "text": "", "view": [0, 2, -8, -1.5, 0.5, 0, 50, 1.5]}

# Where the window shows the place of the annotation, and where its marker is.
_NOTE_PLACE = (
    "(({ annotations: [note], app: { root } }) => {"
    "const point = root.getPosition().clone().set(...note.position);"
    "const { x, y } = root.findByName('camera').camera.worldToScreen(point);"
    "return [x, y]; })(window.sse.viewer)"
)
_MARKER = (
    "document.querySelector('.sse-annotation-hotspot').style.transform"
    ".match(/[-\\d.]+/g).slice(0, 2).map(Number)"
)


def tilted_floor() -> Gaussians:
    """A floor that rises along x, −y is up, of round Gaussians without gaps."""
    side = 40
    x, z = torch.meshgrid(torch.linspace(-3, 3, side), torch.linspace(-3, 3, side), indexing="ij")
    box = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
    floor = gaussians_in_box(box, side * side, torch.Generator().manual_seed(0), 0)
    flat = torch.stack(
        [x.flatten() * math.cos(TILT), -x.flatten() * math.sin(TILT), z.flatten()], 1
    )
    floor.means.copy_(flat)
    floor.log_scales.fill_(math.log(0.08))
    floor.opacity_logits.fill_(4.0)
    return floor


def tilt_of(gaussians: Gaussians) -> float:
    """Degrees between the normal of the floor and the y axis."""
    _, _, axes = torch.linalg.svd(gaussians.means - gaussians.means.mean(0), full_matrices=False)
    return math.degrees(math.acos(min(1.0, abs(float(axes[2, 1])))))


def middle_of(page: Page, handle: int) -> tuple[float, float]:
    x, y, width, height = page.evaluate(
        f"(({{ x, y, width, height }}) => [x, y, width, height])"
        f"(document.querySelectorAll('.snow-handle')[{handle}].getBoundingClientRect())"
    )
    return x + width / 2, y + height / 2


def place_of(page: Page, across: float, z: float) -> tuple[float, float]:
    """Where the window shows a place of the floor."""
    x, y = page.evaluate(
        "(() => { const { root } = window.sse.viewer.app;"
        "const point = root.findByName('gsplat').getPosition().clone()"
        f".set({across * math.cos(TILT)}, {-across * math.sin(TILT)}, {z});"
        "root.findByName('gsplat').getWorldTransform().transformPoint(point, point);"
        "const { x, y } = root.findByName('camera').camera.worldToScreen(point);"
        "const { left, top } = document.querySelector('canvas').getBoundingClientRect();"
        "return [left + x, top + y]; })()"
    )
    return x, y


def faces(page: Page) -> list[float]:
    return page.evaluate(
        "[...document.querySelectorAll('.snow-handle')].map(each => Number(each.ariaValueNow))"
    )


# Whether the first handle has not moved for a second.
STILL = """(() => {
    const { left } = document.querySelector(".snow-handle").getBoundingClientRect();
    if (left !== window.lastLeft) [window.lastLeft, window.since] = [left, performance.now()];
    return performance.now() - window.since > 1000;
})()"""


@pytest.mark.usefixtures("in_process")
def test_box_and_level_by_clicks(studio, finished):
    floor = tilted_floor()
    file = finished.scene_file()
    write_gaussians(file, floor)
    publish(file, finished.site, overwrite=True)
    address = f"scenes/{finished.name}"
    nothing = [False] * len(floor)
    assert studio.ask(f"{address}/edit", "POST", edit_of(nothing, notes=[NOTE]))[0] == 200
    with Browser(900, 600, frames=4.0) as browser:
        page = browser.open(f"{studio.server.url}{address}/site/index.html", timeout=60)
        page.wait_for("!!document.querySelector('.snow-edit')", 120)
        page.evaluate("document.querySelector('.sse-controlsHintClose')?.click()")
        press(page, "Edit")
        press(page, "Box")
        # x points to the left in the first view: the right handle is that of the lower side.
        page.wait_for("document.querySelector('.snow-handle').style.transform !== ''")
        page.wait_for(STILL)  # the view flies to the box
        before, (x, y) = faces(page), middle_of(page, 0)
        first = page.evaluate("document.querySelector('.snow-handle').getBoundingClientRect().left")
        page.drag(x, y, x - 60, y)
        after = faces(page)
        assert after[0] > before[0] + 0.2
        assert after[1:] == before[1:]
        # With the next frame, the handle is where the pointer is.
        left = "document.querySelector('.snow-handle').getBoundingClientRect().left"
        page.wait_for(f"Math.abs({left} - {first - 60}) < 1.5")
        page.evaluate("document.querySelectorAll('.snow-handle')[1].focus()")
        # Keys with a short time between them are one step; a drag is one, too.
        begin, step = time.time(), (before[1] - before[0]) / 100
        for seconds in (0.0, 0.3, 0.6, 2.0):
            page.key("ArrowLeft", timestamp=begin + seconds)
        assert faces(page)[1] == pytest.approx(before[1] - 4 * step)
        end = faces(page)
        page.key("z", 2)
        assert faces(page)[1] == pytest.approx(before[1] - 3 * step)
        page.key("z", 2)
        assert faces(page) == after
        press(page, "Box")  # the box is closed, and shown again by what undoes a step of it
        assert page.evaluate("document.querySelector('.snow-handles').hidden")
        page.key("z", 2)
        assert not page.evaluate("document.querySelector('.snow-handles').hidden")
        assert faces(page) == before
        press(page, "Redo")
        assert faces(page) == after
        for _ in range(2):
            page.key("y", 2)
        assert faces(page) == end
        x, y, width, height = page.evaluate(
            "(({ x, y, width, height }) => [x, y, width, height])"
            "(document.querySelector('.snow-sides input').getBoundingClientRect())"
        )
        page.drag(x + width / 2, y + height / 2, x + width / 4, y + height / 2)
        assert faces(page)[0] != end[0]
        press(page, "Undo")
        assert faces(page) == end
        press(page, "Select what is outside")
        shown = page.evaluate("document.querySelector('.snow-edit > p').textContent")
        assert 10 < int(shown.split()[0].replace(",", "")) < len(floor) / 2
        press(page, "Undo")
        # Three clicks; the annotation of the viewer follows, before anything is saved.
        place = page.evaluate(_NOTE_PLACE)
        press(page, "Level and turn")
        dots = "document.querySelector('.snow-level [role=status]').textContent"
        for i, place in enumerate(((0.8, -1.0), (2.4, 0.0), (0.8, 1.6))):
            page.click(*place_of(page, *place))
            page.wait_for(f"{dots} === '{i + 1} of 3 points'" if i < 2 else f"{dots} === ''", 60)
        assert math.dist(page.evaluate(_NOTE_PLACE), place) > 20
        x, y = page.evaluate(_NOTE_PLACE)
        page.wait_for(f"(([x, y]) => Math.hypot(x - {x}, y - {y}) < 2)({_MARKER})")
        page.evaluate("window.old = true")
        press(page, "Save")
        page.wait_for("!window.old && !!document.querySelector('.snow-edit')", 180)
        assert not page.errors
    assert tilt_of(floor) == pytest.approx(20, abs=0.1)
    assert tilt_of(read_gaussians(finished.scene_file())) < 2
