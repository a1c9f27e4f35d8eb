"""What a person makes in the page of a scene: `edit`: a new scene beside it; `film`: a video."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from snowsplat import trajectory
from snowsplat.formats import GaussianArrays
from snowsplat.formats.ply import write_ply
from snowsplat.formats.sog import order_in_sog, read_sog
from snowsplat.pipeline.compute import Compute
from snowsplat.pipeline.observer import SILENT, Observer
from snowsplat.pipeline.options.video import VideoOptions
from snowsplat.pipeline.output.scene_source import change_of, load_viewable, moved_origin
from snowsplat.pipeline.videos import render_video
from snowsplat.project.edit_record import (
    EditRecord,
    PageEdit,
    edited_file,
    read_record,
    remove_edited,
    written_with_record,
)
from snowsplat.project.page_film import PageFilm
from snowsplat.project.project import Project
from snowsplat.project.site_folder import SiteFolder
from snowsplat.scene.camera import Camera
from snowsplat.scene.camera_json import entries_of
from snowsplat.scene.edit import transform, with_sh_degree
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import Similarity, quat_from_rotation, quat_product
from snowsplat.util.errors import UserError
from snowsplat.util.files import write_json
from snowsplat.viewer.web.panel import numbers_of, rotation_of_page, view_numbers, view_of_page

# SOG stores positions in steps. They differ from those of the scene by at most half of one, and
# float32 numbers by this share.
_ROUNDING = 1e-5
_PREVIEW = 10.0  # cameras per second
_MOST = 600  # cameras of a preview


class OtherScene(UserError):
    """The page shows another scene than the file contains."""


def edit(scene: Path | str, site: Path | str, changes: PageEdit) -> Path:
    """Write the edited scene beside ``scene``, which stays as it is; returns its file.

    This is NAME_edited.ply, with its record NAME_edited.json. If ``scene`` is such a file itself,
    it is replaced.

    Args:
        scene: a scene file.
        site: the site that `publish` has written of it, without levels of detail: the page.

    Raises:
        OtherScene: the page shows another scene.
        UserError: the scene is missing or damaged.
        OSError: the file cannot be written.
    """
    scene = Path(scene)
    project = Project.open(scene)
    source = load_viewable(project)
    frame = source.frame()
    # The largest part of the Gaussians, their colours, is not copied.
    moved = transform(with_sh_degree(source.gaussians, 0), frame)
    usable = source.gaussians.usable_rows()
    rows = _rows_of_page(scene, moved, usable, Path(site))
    if len(rows) != changes.count:
        raise OtherScene(
            "the page has {count} Gaussians, the scene has {rows}",
            count=changes.count,
            rows=len(rows),
        )
    removed = np.zeros(len(source.gaussians), bool)
    bits = np.unpackbits(np.frombuffer(changes.bits(), np.uint8), bitorder="little")
    removed[rows] = bits[: len(rows)] == 1
    if changes.hidden is not None:
        removed |= _hidden(moved, changes.hidden)
    if removed.all():
        raise UserError("nothing would be left of the scene; keep some of it")
    kept = source.gaussians
    kept.select_(torch.from_numpy(~removed))
    before = project.edit or EditRecord(scene.name, 0)
    change, turn = replace(Similarity.identity(), scale=changes.scale), before.turn
    if changes.turn is not None:
        # The world of the edited scene is upright as its page.
        rotation = rotation_of_page(changes.turn) @ frame.rotation
        change = replace(change, rotation=rotation)
        quat, already = quat_from_rotation(rotation), turn or [1.0, 0.0, 0.0, 0.0]
        turn = quat_product(quat, torch.tensor(already, dtype=torch.float64)).tolist()
    if changes.scale != 1 or changes.turn is not None:
        kept = replace(transform(kept, change), origin=moved_origin(kept.origin, change))
    if changes.scale != 1:
        # The page asks for the true distance in metres, so a unit is a metre now.
        kept = replace(kept, metres_per_unit=1.0)
    back = frame.inverse()

    def in_scene(view: list[float]) -> list[float]:
        return numbers_of(view_of_page(view).transformed(back).transformed(change))

    start = None if source.start is None else numbers_of(source.start.transformed(change))
    notes = [replace(n, view=numbers_of(v.transformed(change))) for n, v in source.notes]
    if changes.start is not None:
        start = in_scene(changes.start)
    if changes.notes is not None:
        notes = [replace(note, view=in_scene(note.view)) for note in changes.notes]
    record = replace(
        before,
        removed=before.removed + int(removed.sum()),
        scale=before.scale * changes.scale,
        title=changes.title or before.title,
        start=start,
        notes=tuple(notes),
        turn=turn,
    )
    target = edited_file(scene)
    with written_with_record(target, record) as temporary:
        write_ply(temporary, GaussianArrays.from_gaussians(kept))
    return target


def undo_edits(edited: Path | str) -> Path:
    """Remove an edited scene; returns the file of the scene that was edited.

    Raises: UserError: this is no edited scene.
    """
    edited = Path(edited)
    record = read_record(edited)
    if record is None:
        raise UserError("{edited}: this scene was not edited; nothing to take back", edited=edited)
    remove_edited(edited)
    return edited.with_name(Path(record.scene).name)


def _hidden(gaussians: Gaussians, limits: tuple[float, float, float, float, float]) -> np.ndarray:
    """(N,) what the sliders hide of the Gaussians in the frame of the page; see `PageEdit`."""
    x, y, z, distance, size = limits
    middle = torch.tensor([-x, -y, z])  # the world of the viewer is rotated about the z axis
    far = (gaussians.means.detach().cpu() - middle).norm(dim=1) > distance
    large = gaussians.log_scales.detach().cpu().amax(1).exp() > size
    return (far | large).numpy()


def _rows_of_page(scene: Path, gaussians: Gaussians, usable: Tensor, site: Path) -> np.ndarray:
    """(N,) the ``usable`` rows of a scene, in the frame of its page, in the order of the page.

    The file of the page is in the order of a space-filling curve. The order is computed again, and
    the positions in the file must be those of the rows.
    """
    arrays = GaussianArrays.from_gaussians(gaussians.select(usable))
    order = order_in_sog(scene, arrays)
    rows = usable.nonzero()[:, 0].numpy()[order]
    content = SiteFolder(site).scene()
    if content is None:
        raise OtherScene("{site}: the page did not show {name}", site=site, name=scene.name)
    shown, expected = (_logs(a) for a in (read_sog(content).means, arrays.means[order]))
    if shown.shape == expected.shape and len(rows):
        step = np.ptp(expected, axis=0) / 65535
        if (np.abs(shown - expected) <= 0.51 * step + _ROUNDING * np.abs(expected)).all():
            return rows
    raise OtherScene("{site}: the page did not show {name}", site=site, name=scene.name)


def _logs(means: np.ndarray) -> np.ndarray:
    """The numbers that SOG stores in even steps."""
    values = means.astype(np.float64)
    return np.sign(values) * np.log1p(np.abs(values))


def film(
    scene: Path | str,
    plan: PageFilm,
    keys: Path | str,
    target: Path | str,
    *,
    compute: Compute | None = None,
    observer: Observer = SILENT,
) -> Path:
    """Render a film; the same as `render_video` with the path ``keys``.

    Args:
        scene: a scene file.
        plan: its keys are in the frame of the page of the scene.
        keys: the camera list (JSON) that is written first: the keys in the world of the scene.
        target: the .mp4 file.
        observer: gets the stage "video".

    Raises:
        UserError: the scene is missing or damaged, or all keys are the same.
        KeyboardInterrupt: Ctrl-C; an earlier film is kept.
    """
    write_keys(scene, plan, keys)
    options = VideoOptions(path=str(keys), seconds=plan.seconds, size=plan.size, ease=plan.ease)
    (file,) = render_video(scene, options, target=target, compute=compute, observer=observer)
    return file


def write_keys(scene: Path | str, plan: PageFilm, keys: Path | str) -> None:
    """Write the keys of a film as a camera list in the world of the scene; see `film`."""
    cameras, speeds, _, _ = _keys(Path(scene), plan)
    entries = entries_of((str(i), camera) for i, camera in enumerate(cameras))
    for entry, speed in zip(entries, speeds, strict=True):
        entry["speed"] = speed
    write_json(Path(keys), entries)


def page_frames(scene: Path | str) -> list[Similarity]:
    """The transforms, one after the other, from the world of a scene as it was made, before all
    edits, to the frame of its page.

    Raises: UserError: the scene is missing or damaged.
    """
    project = Project.open(scene)
    edits = [] if project.edit is None else [change_of(project.edit)]
    return [*edits, load_viewable(project).frame()]


def moved_film(plan: PageFilm, before: list[Similarity], after: list[Similarity]) -> PageFilm:
    """The plan with its keys at the same places of a scene whose page has another frame; see
    `page_frames`."""
    changes = [*(change.inverse() for change in reversed(before)), *after]
    keys = []
    for key in plan.keys:
        view = view_of_page(key)
        for change in changes:
            view = view.transformed(change)
        keys.append([*view_numbers(view, view.aspect), view.aspect])
    return replace(plan, keys=keys)


def film_preview(scene: Path | str, plan: PageFilm) -> list[list[float]]:
    """The path of a film, for its page: cameras at equal distances in time.

    Each camera is its position, a point ahead, the direction up, and the vertical field of view in
    degrees, in the frame of the page.

    Raises: UserError: see `film`.
    """
    cameras, speeds, means, change = _keys(Path(scene), plan)
    distance = trajectory.viewing_distance(cameras, means)
    count = max(2, min(_MOST, round(plan.seconds * _PREVIEW)))
    path = trajectory.key_path(cameras, count, distance, ease=plan.ease, speeds=speeds)
    return [_in_page(camera.transformed(change)) for camera in path]


def _keys(
    scene: Path, plan: PageFilm
) -> tuple[Sequence[Camera], Sequence[float], Tensor, Similarity]:
    """The key cameras in the world of the scene and their speeds, its means (N, 3), and the change
    to the page."""
    source = load_viewable(scene)
    change = source.frame()
    back = change.inverse()
    cameras = [view_of_page(key).camera(*plan.pixels()).transformed(back) for key in plan.keys]
    speeds = plan.speeds or (1.0,) * len(cameras)
    if plan.loop:
        cameras, speeds = [*cameras, cameras[0]], (*speeds, speeds[0])
    return cameras, speeds, source.gaussians.means, change


def _in_page(camera: Camera) -> list[float]:
    """In the world of the viewer, which is rotated by 180° about the z axis."""
    pose = camera.world_from_cam
    turned = torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64)[:, None] * pose
    place, ahead, up = turned[:, 3], turned[:, 2], -turned[:, 1]
    half = 0.5 * camera.height / camera.fy
    fov = float(torch.rad2deg(2 * torch.atan(torch.tensor(half, dtype=torch.float64))))
    return [*place.tolist(), *(place + ahead).tolist(), *up.tolist(), fov]
