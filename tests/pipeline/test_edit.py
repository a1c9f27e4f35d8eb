"""`edit`: the order of the page, scale, views, titles, and the way back."""

import base64
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.gaussians import gaussians_in_box

from snowsplat.formats import read_gaussians, write_gaussians
from snowsplat.formats.sog import read_sog
from snowsplat.pipeline.edit import OtherScene, edit, moved_film, page_frames, undo_edits
from snowsplat.pipeline.output.scene_source import load_viewable
from snowsplat.pipeline.publish import publish, viewed_scene
from snowsplat.project import edit_record
from snowsplat.project.edit_record import Note, PageEdit, read_record, shown_file
from snowsplat.project.page_film import PageFilm
from snowsplat.project.site_folder import SiteFolder
from snowsplat.project.training_folder import TrainingFolder
from snowsplat.scene.camera import Camera
from snowsplat.scene.camera_json import write_cameras
from snowsplat.scene.geometry import look_at
from snowsplat.util.errors import UserError
from snowsplat.util.files import write_json

N = 203  # no multiple of 8

VIEW = [0.0, 1.0, -9.0, 0.0, 0.0, 0.0, 40.0, 1.5]


def bits(rows: np.ndarray) -> str:
    return base64.b64encode(np.packbits(rows, bitorder="little").tobytes()).decode()


@pytest.fixture(scope="module")
def published(tmp_path_factory):
    """Scenes and their pages, without and with cameras."""
    folders = [tmp_path_factory.mktemp(name) for name in ("file", "cameras")]
    for with_cameras, folder in enumerate(folders):
        write_scene(folder, bool(with_cameras))
    return folders


@pytest.fixture
def scene(request, published, tmp_path):
    """In the folder of `make`, with cameras, unless a test is marked with `either`."""
    shutil.copytree(published[getattr(request, "param", 1)], tmp_path, dirs_exist_ok=True)
    return tmp_path / "made" / "tour.ply"


either = pytest.mark.parametrize("scene", [0, 1], ids=["file", "cameras"], indirect=True)


def write_scene(folder: Path, with_cameras: bool) -> Path:
    """A scene file; with cameras, in the folder of `make`, tilted and large: the page turns it."""
    box = torch.tensor([[-40.0, -40.0, -40.0], [40.0, 40.0, 40.0]])
    gaussians = gaussians_in_box(box, N, torch.Generator().manual_seed(0), 1)
    gaussians = replace(gaussians, log_scales=gaussians.log_scales + 2.0)
    file = folder / "made" / "tour.ply"
    file.parent.mkdir()
    write_gaussians(file, gaussians)
    if with_cameras:
        trained = TrainingFolder(file.parent / "scene")
        trained.scene_path(1).parent.mkdir(parents=True)
        write_gaussians(trained.scene_path(1), gaussians)
        write_json(file.parent / "make.json", {"file": "tour.ply", "title": "The tour"})
        up = torch.tensor([1.0, -1.0, 0.2], dtype=torch.float64)
        eyes = torch.tensor([[0.0, 0.0, -200.0], [60.0, 5.0, -190.0]], dtype=torch.float64)
        poses = [look_at(eye, torch.zeros(3, dtype=torch.float64), up) for eye in eyes]
        cameras = [Camera(60, 40, 50.0, 50.0, 30.0, 20.0, pose) for pose in poses]
        write_cameras(trained.path / "cameras.json", zip("ab", cameras, strict=True))
    publish(file, folder / "site")
    return file


@either
def test_what_is_removed_in_the_page_is_removed_in_the_scene(scene, tmp_path):
    before = scene.read_bytes()
    gone = np.random.default_rng(1).random(N) < 0.4
    shown = read_sog(SiteFolder(tmp_path / "site").scene())
    target = edit(scene, tmp_path / "site", PageEdit(N, bits(gone)))
    assert (target.name, scene.read_bytes()) == ("tour_edited.ply", before)
    publish(target, tmp_path / "after")
    after = read_sog(SiteFolder(tmp_path / "after").scene())
    # The opacities, in the order of a line through the page, tell which ones are left.
    assert len(after.means) == N - gone.sum()
    expected = np.sort(shown.opacity_logits[~gone])
    assert np.allclose(np.sort(after.opacity_logits), expected)
    # Bits of the file: rows of the other file, in their order.
    whole, kept = read_gaussians(scene), read_gaussians(target)
    rows = [int((whole.means == mean).all(1).nonzero()[0]) for mean in kept.means]
    assert rows == sorted(rows)
    for name, tensor in kept.parameters().items():
        assert torch.equal(tensor, whole.parameters()[name][rows])


def test_what_the_sliders_hide_is_removed(scene, tmp_path):
    """As the page does it: by the centres and sizes that it shows."""
    shown = read_sog(SiteFolder(tmp_path / "site").scene())
    # The world of the viewer is rotated about the z axis.
    x, y, z = np.median(shown.means, axis=0)
    distances = np.linalg.norm(shown.means - [x, y, z], axis=1)
    sizes = np.exp(shown.log_scales.max(1))
    # The numbers of the page have steps: limits between two of the numbers.
    distance, size = (np.sort(v)[[N // 2, N // 2 + 1]].mean() for v in (distances, sizes))
    hidden = (-float(x), -float(y), float(z), float(distance), float(size))
    target = edit(scene, tmp_path / "site", PageEdit(N, bits(np.zeros(N, bool)), hidden=hidden))
    removed = read_record(target).removed
    assert abs(removed - ((distances > distance) | (sizes > size)).sum()) <= 2
    assert N - len(read_gaussians(target)) == removed > N // 2
    far = PageEdit(len(read_gaussians(target)), bits(np.zeros(N - removed, bool)), hidden=None)
    publish(target, tmp_path / "site", overwrite=True)
    edit(target, tmp_path / "site", far)
    assert read_record(target).removed == removed


def test_annotations_stay_at_their_places(scene, tmp_path):
    """In the page, with a scale, and over further edits; the page flies to them."""
    note = Note("A <b>", "text", [*VIEW[:3], 1.0, 2.0, 3.0, *VIEW[6:]])
    change = PageEdit(N, bits(np.arange(N) < 1), 2.0, notes=(note,))
    target = edit(scene, tmp_path / "site", change)
    publish(target, tmp_path / "site", overwrite=True)
    ratio = page_scale(target) * 2 / page_scale(scene)
    expected = np.array(note.view[:6]) * ratio
    for _ in range(2):
        (shown,) = settings_of(tmp_path / "site")["annotations"]
        assert (shown["title"], shown["text"]) == ("A <b>", "text")
        assert np.allclose(shown["position"], expected[3:])
        assert np.allclose(shown["camera"]["initial"]["position"], expected[:3])
        assert np.allclose(shown["camera"]["initial"]["target"], expected[3:])
        edit(target, tmp_path / "site", PageEdit(N - 1, bits(np.zeros(N - 1, bool))))
        publish(target, tmp_path / "site", overwrite=True)
    edit(target, tmp_path / "site", PageEdit(N - 1, bits(np.zeros(N - 1, bool)), notes=()))
    assert read_record(target).notes == ()
    for wrong in (
        ("", "x", VIEW),
        ("x" * 61, "", VIEW),
        ("x", "y" * 281, VIEW),
        ("x", "", VIEW[1:]),
    ):
        with pytest.raises(ValueError, match="annotation"):
            Note(*wrong)
    with pytest.raises(ValueError, match="at most 25"):
        PageEdit(N, bits(np.zeros(N, bool)), notes=26 * (note,))


def page_scale(scene: Path) -> float:
    return load_viewable(scene).frame().scale


def settings_of(site: Path) -> dict:
    page = (site / "index.html").read_text("utf-8")
    return json.loads(page.split('id="sse-bootstrap">')[1].split("</script>")[0])["settings"]


@either
def test_scale_view_and_title(scene, tmp_path):
    first = PageEdit(N, bits(np.arange(N) < 1), 2.0, "New", VIEW)
    target = edit(scene, tmp_path / "site", first)
    record = read_record(target)
    assert (record.removed, record.scale, record.title) == (1, 2.0, "New")
    assert torch.allclose(
        read_gaussians(target).means.norm(dim=1).max(),
        2 * read_gaussians(scene).means.norm(dim=1).max(),
    )
    if load_viewable(scene).cameras:
        seen, before = load_viewable(target).cameras[1], load_viewable(scene).cameras[1]
        assert torch.allclose(seen.position, 2 * before.position)
    # The page of the edited scene begins with the view, at the same place in the scene.
    publish(target, tmp_path / "again")
    with viewed_scene(target) as viewed:
        page = viewed.files[""].content.decode()
    assert '"title": "New"' in page
    initial = settings_of(tmp_path / "again")["cameras"][0]["initial"]
    assert np.allclose(initial["position"], VIEW[:3], atol=0.1)
    # Another edit goes on from there: sizes and numbers add up, the view stays.
    rest = N - 1
    again = edit(target, tmp_path / "again", PageEdit(rest, bits(np.arange(rest) < 5), 0.5))
    assert again == target
    second = read_record(target)
    assert (second.removed, second.scale, second.title) == (6, 1.0, "New")
    assert np.allclose(second.start[:6], 0.5 * np.array(record.start[:6]))
    assert shown_file(scene) == target
    assert undo_edits(target) == scene
    assert shown_file(scene) == scene
    assert [each.name for each in scene.parent.glob("tour*")] == ["tour.ply"]


@either
def test_a_person_turns_the_scene(scene, tmp_path):
    """The page shows it as it was turned, although the cameras say otherwise; so does a film."""
    site, (original, before) = tmp_path / "site", (scene.read_bytes(), read_sog_places(tmp_path))
    note = Note("A", "", VIEW)
    turn = [0.5**0.5, 0.0, 0.0, 0.5**0.5]  # 90° about z of the viewer: x becomes y
    plan = PageFilm([VIEW, [*VIEW[:2], -5.0, *VIEW[3:]]])
    frames = page_frames(scene)
    target = edit(
        scene, site, PageEdit(N, bits(np.arange(N) < 0), start=VIEW, notes=(note,), turn=turn)
    )
    publish(target, site, overwrite=True)
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    ratio = page_scale(target) / page_scale(scene)
    expected = ratio * before @ quarter.T
    assert match(read_sog_places(tmp_path), expected) < 0.01
    (shown,) = settings_of(site)["annotations"]
    place = ratio * quarter @ np.array(VIEW[3:6])
    assert np.allclose(shown["position"], place, atol=1e-6)
    film = moved_film(plan, frames, page_frames(target))
    assert np.allclose(film.keys[0][:3], ratio * quarter @ VIEW[:3], atol=1e-6)
    # The cameras turn with the scene: they see the same.
    seen, first = load_viewable(target), load_viewable(scene)
    for camera, other in zip(seen.cameras, first.cameras, strict=True):
        pixels, others = camera.project(seen.gaussians.means), other.project(first.gaussians.means)
        assert torch.allclose(pixels[0], others[0], atol=1e-2)
    # A second turn adds up; the original has the same bytes.
    back = [turn[0], 0.0, 0.0, -turn[3]]
    edit(target, site, PageEdit(N, bits(np.arange(N) < 0), turn=back))
    publish(target, site, overwrite=True)
    assert match(read_sog_places(tmp_path), page_scale(target) / page_scale(scene) * before) < 0.01
    assert undo_edits(target).read_bytes() == original


def read_sog_places(folder: Path) -> np.ndarray:
    """(N, 3) the centres in the viewer."""
    return read_sog(SiteFolder(folder / "site").scene()).means * [-1.0, -1.0, 1.0]


def match(places: np.ndarray, expected: np.ndarray) -> float:
    """The largest distance to the nearest other place, relative to the size."""
    distances = np.linalg.norm(places[:, None] - expected, axis=2)
    return float(distances.min(1).max() / np.ptp(expected))


def test_the_page_is_that_of_the_scene(scene, tmp_path):
    site = tmp_path / "site"
    moved = read_gaussians(scene)
    moved.means[7] += 3.0
    write_gaussians(scene, moved)
    with pytest.raises(OtherScene):
        edit(scene, site, PageEdit(N, bits(np.arange(N) < 1)))
    publish(scene, site, overwrite=True)
    with pytest.raises(OtherScene, match="page"):
        edit(scene, site, PageEdit(N - 1, bits(np.arange(N - 1) < 1)))
    with pytest.raises(UserError, match="nothing would be left"):
        edit(scene, site, PageEdit(N, bits(np.ones(N, bool))))
    with pytest.raises(UserError, match="not edited"):
        undo_edits(scene)
    assert not list(scene.parent.glob("*_edited*"))


@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        ({"removed": "AAAA"}, "24 bits are not those of 203"),
        ({"removed": "?"}, "base64"),
        ({"count": 0, "removed": ""}, "bits"),
        ({"scale": 0.0}, "not positive"),
        ({"scale": 1e300}, "times as large"),
        ({"start": [0.0] * 8}, "view"),
        ({"start": [1.0]}, "view"),
        ({"turn": [0.0] * 4}, "rotation"),
        ({"turn": [1.0]}, "rotation"),
    ],
)
def test_impossible_changes(wrong, why):
    with pytest.raises(ValueError, match=why):
        PageEdit(**{"count": N, "removed": bits(np.zeros(N, bool)), **wrong})


class Killed(BaseException):
    pass


@pytest.mark.parametrize("moment", ["file", "announced", "replaced", "record"])
def test_a_process_that_is_killed_leaves_one_edit_or_the_other(scene, tmp_path, moment):
    """At each moment of a second edit, the scene that is shown has its own record."""
    first = edit(scene, tmp_path / "site", PageEdit(N, bits(np.arange(N) < 3), scale=2.0))
    publish(first, tmp_path / "site", overwrite=True)
    was = (first.read_bytes(), read_record(first))

    def write(path, value):
        stage = {"tour_edited.next.json": "announced", "tour_edited.json": "record"}[path.name]
        if moment == {"announced": "file", "record": "replaced"}[stage]:
            raise Killed
        write_json(path, value)
        if moment == stage:
            raise Killed

    again = PageEdit(N - 3, bits(np.arange(N - 3) < 4), scale=3.0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(edit_record, "write_json", write)
        with pytest.raises(Killed):
            edit(first, tmp_path / "site", again)
    shown = shown_file(scene)
    if moment in ("file", "announced"):
        assert (shown.read_bytes(), read_record(shown)) == was
    else:
        record = read_record(shown)
        assert (record.removed, record.scale, len(read_gaussians(shown))) == (7, 6.0, N - 7)
    assert undo_edits(shown) == scene
    assert [file.name for file in scene.parent.glob("tour_edited*")] == []
