"""Messages of the page: those it sends are understood, all others are refused."""

import json
import math

import pytest
import torch

from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import look_at, quat_from_rotation
from snowsplat.viewer.live.browser import Key, Share, Shown, Thumbnails, Training, parse, to_json
from snowsplat.viewer.live.pictures import Display, PhotoRectangle, View

from .. import clients


def test_messages_of_the_page():
    seen = parse(clients.view(number=7, position=[1, 2.5, -3], photo=2))
    assert isinstance(seen, View)
    assert (seen.number, seen.photo) == (7, 2)
    assert seen.camera(4, 3).position.tolist() == [1.0, 2.5, -3.0]
    shown = parse(clients.display(mode="depth", crop=[[0, 0, 0], [1, 1, 1]]))
    assert isinstance(shown, Display)
    assert shown.crop == ((0, 0, 0), (1, 1, 1))
    assert parse('{"type": "shown", "number": 3}') == Shown(3)
    assert parse('{"type": "training", "do": "pause"}') == Training("pause")
    assert parse('{"type": "share", "share": 0.3}') == Share(0.3)
    assert parse('{"type": "thumbnails", "count": 4}') == Thumbnails(4)
    assert parse('{"type": "key"}') == Key()


def test_other_messages_are_refused():
    """Or, if a wrong value is possible at its place, it is limited."""
    refused = 0
    for text in clients.wrong_messages():
        try:
            message = parse(text)
        except ValueError:
            refused += 1
            continue
        if isinstance(message, View):
            assert message.camera(4, 3).is_finite(), text
        elif isinstance(message, Display):
            assert 320 <= message.longest <= 2560, text
            assert 0 <= message.degree <= 3, text
            assert 0.02 <= message.scale <= 1.0, text
            assert 0.0 <= message.wipe <= 1.0, text
        elif isinstance(message, Share):
            assert 0.05 <= message.share <= 0.95, text
    assert refused > 200
    for text in ("[" * 4000, "[" * 60_000, "9" * 4000, clients.view()[:-9], "\ufeff", "\0"):
        with pytest.raises(ValueError):  # noqa: PT011 - any one
            parse(text)


def test_numbers_are_what_json_has():
    values = {"loss": math.nan, "curve": [(1.0, math.inf), (math.pi, 2)]}
    assert json.loads(to_json(values)) == {
        "loss": None,
        "curve": [[1.0, None], [3.141593, 2]],
    }


def pose(fov: float = 1.0, width: int = 640, height: int = 480) -> View:
    eye = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    cam_from_world = look_at(eye, torch.zeros(3).double(), torch.tensor([0.0, -1.0, 0.0]).double())
    quat = quat_from_rotation(cam_from_world[:, :3].T)
    return View(0, tuple(quat.tolist()), tuple(eye.tolist()), fov, width, height)


def test_the_camera_of_a_browser():
    camera = pose().camera(320, 240)
    assert torch.allclose(camera.position, torch.tensor([1.0, 2.0, 3.0]).double())
    middle, depth = camera.project(torch.zeros(1, 3).double())
    assert middle[0].tolist() == pytest.approx([160, 120])
    assert float(depth) == pytest.approx(math.sqrt(14))
    assert 2 * math.atan(120 / camera.fy) == pytest.approx(1.0)


@pytest.mark.parametrize("window", [(640, 200), (200, 640), (300, 300)])
def test_a_photo_in_a_window_has_its_own_camera(window):
    """A point projects to the same position of the photo, for any rectangle."""
    identity = torch.eye(3, 4, dtype=torch.float64)
    camera = Camera(90, 60, 70.0, 72.0, 44.0, 31.0, identity)
    placed = PhotoRectangle.within(camera, *window)
    assert placed.width <= window[0]
    assert placed.height <= window[1]
    assert placed.width == window[0] or placed.height == window[1]
    assert placed.width / placed.height == pytest.approx(1.5, rel=0.02)
    whole = placed.camera(camera, *window)
    assert (whole.width, whole.height) == window
    points = torch.tensor([[0.1, 0.2, 1.0], [-0.5, 0.3, 2.0]]).double()
    own, _ = camera.project(points)
    there, _ = whole.project(points)
    scale = torch.tensor([placed.width / 90, placed.height / 60])
    corner = torch.tensor([placed.left, placed.top])
    assert torch.allclose(there, own * scale + corner)
