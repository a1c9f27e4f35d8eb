"""`edit`: what a person has changed in the page of a scene, as a new scene beside it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from snowsplat.formats import GaussianArrays
from snowsplat.formats.ply import write_ply
from snowsplat.formats.sog import order_in_sog, read_sog
from snowsplat.pipeline.output.scene_source import load_viewable, moved_origin
from snowsplat.project.edit_record import (
    EditRecord,
    PageEdit,
    edited_file,
    read_record,
    remove_edited,
    written_with_record,
)
from snowsplat.project.project import Project
from snowsplat.project.site_folder import SiteFolder
from snowsplat.scene.edit import transform, with_sh_degree
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import Similarity, quat_from_rotation, quat_product
from snowsplat.util.errors import UserError
from snowsplat.viewer.web.panel import numbers_of, rotation_of_page, view_of_page

# SOG stores positions in steps. They differ from those of the scene by at most half of one, and
# float32 numbers by this share.
_ROUNDING = 1e-5


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
