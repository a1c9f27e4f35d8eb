"""The panel of the page: what the viewer does not show itself.

It names the scene, has the stops along the path of the photos, and makes links to the present view.
Its script also fits what a view must show into the window, and frames the subject. Style sheet and
scripts are `panel.css`, `texts.js`, `hiding.js` and `panel.js`; `viewer_page.page` inserts them,
and `failure.js`, the script for a page that shows no scene.

Its sliders hide Gaussians far from the subject, and large Gaussians. In places that no photo shows,
a trained scene has Gaussians that are much larger than those of the surfaces. `hiding.js` hides
Gaussians by distance and by size while they are copied for the drawing; the scene itself is not
changed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import rotation_from_quat
from snowsplat.scene.initial_view import InitialView
from snowsplat.viewer.web.stops import Stops

#: The sliders begin at this quantile of the distances and sizes: what is beyond goes first.
_MOST = 0.999
#: The smallest distance and size that are kept, relative to the radius of the subject.
_NEAREST, _SMALLEST = 0.25, 0.03
# Without cameras, what is larger than this, relative to the radius, is hidden at first; but at most
# this share of the Gaussians.
_FLOATER, _FEW = 0.1, 0.02
_ROWS_SAMPLED = 1_000_000


@dataclass(frozen=True)
class Description:
    """What a page says about its scene."""

    title: str  # the name of the scene
    licence: str = ""  # the licence of the scene, such as "CC BY 4.0"; "" if it is not stated
    made: date | None = None  # the day on which the scene was made; None if it is not known
    grade: str = ""  # that of the verdict on it: good, usable or poor; "" if it is not shown

    def facts(self, gaussians: int) -> str:
        """The facts in one line: number of Gaussians, date, licence."""
        made = self.made.isoformat() if self.made else ""
        return " · ".join(filter(None, (f"{gaussians:,} Gaussians", made, self.licence)))


def made_on(file: Path) -> date:
    """The day on which a scene file was written."""
    return date.fromtimestamp(file.stat().st_mtime)


def view_numbers(view: InitialView, aspect: float) -> list[float]:
    """A view as the viewer and the script store it: position, target, field of view.

    The viewer's y axis points up, so it rotates scenes by 180° about the z axis. ``aspect`` is that
    of all views of a page; see `InitialView.with_aspect`.
    """
    (x, y, z), (u, v, w) = view.position, view.target
    return [-x, -y, z, -u, -v, w, view.with_aspect(aspect).fov]


def view_of_page(numbers: Sequence[float]) -> InitialView:
    """The view of such numbers, and its aspect; the inverse of `view_numbers`."""
    x, y, z, u, v, w, fov, aspect = numbers
    return InitialView((-x, -y, z), (-u, -v, w), fov, aspect)


def rotation_of_page(quat: Sequence[float]) -> Tensor:
    """(3, 3) float64: the rotation of a quaternion wxyz of the viewer, in the frame of the page;
    see `view_numbers`."""
    w, x, y, z = quat
    return rotation_from_quat(torch.tensor([w, -x, -y, z], dtype=torch.float64))


def numbers_of(view: InitialView) -> list[float]:
    """Position, target, field of view and aspect of a view, as records store it."""
    return [*view.position, *view.target, view.fov, view.aspect]


def panel_settings(
    about: Description,
    gaussians: int,
    start: InitialView,
    stops: Stops,
    pictures: str,
    hiding: Hiding,
    scale: float,
    metres: float | None,
    first: int,
) -> dict[str, Any]:
    """What the script needs.

    ``gaussians``: their number. ``start``: the initial view. ``stops``: also have the subject,
    which Frame shows. ``pictures``: the address of the image with the pictures of the stops.
    ``scale``: of the page relative to the scene file. ``metres``: in a unit of the scene file, if
    that is known. ``first``: the stop that is the start; -1: it is none.
    """
    x, y, z = stops.middle.tolist()
    return {
        "title": about.title,
        "facts": about.facts(gaussians),
        "grade": about.grade,
        "aspect": start.aspect,
        "start": view_numbers(start, start.aspect),
        "subject": [-x, -y, z, stops.radius],
        "stops": [view_numbers(stop, start.aspect) for stop in stops.views],
        "limits": [
            [round(number, 4) for number in (*seen, *held)]
            for seen, held in zip(stops.seen, stops.held, strict=True)
        ],
        "pictures": pictures,
        "hiding": hiding.settings(),
        "scale": scale,
        "metres": metres,
        "first": first,
    }


@dataclass(frozen=True)
class Hiding:
    """The ranges of the sliders, in world units."""

    # From the subject; what a value just above 0 keeps, and what 100 keeps.
    distance: tuple[float, float]
    size: tuple[float, float]  # of the longest axis of a Gaussian, in standard deviations; likewise
    start: int  # the value for the size at first

    def settings(self) -> dict[str, Any]:
        """What `hiding.js` needs."""
        return {"distance": self.distance, "size": self.size, "start": [0, self.start]}

    def shown(self, gaussians: Gaussians) -> Gaussians:
        """What the page shows at first."""
        if not self.start:
            return gaussians
        largest, least = self.size
        return gaussians.select(
            _sizes(gaussians) <= largest * (least / largest) ** (self.start / 100)
        )


def hiding_of(gaussians: Gaussians, middle: Tensor, radius: float, *, hide: bool) -> Hiding:
    """The ranges for a scene, whose subject has the ``middle`` (3,) and the ``radius``.

    ``hide``: hide floaters at first.
    """
    rows = slice(None, None, -(-len(gaussians) // _ROWS_SAMPLED) or 1)
    distances = (gaussians.means.detach()[rows].double().cpu() - middle).norm(dim=1)
    sizes = _sizes(gaussians)[rows].double().cpu()
    near, small = _NEAREST * radius, _SMALLEST * radius
    # Ranges of at least a factor of 2 have no steps.
    far = max(_quantile(distances, _MOST), 2 * near)
    largest = max(_quantile(sizes, _MOST), 2 * small)
    floater = max(_FLOATER * radius, _quantile(sizes, 1 - _FEW))
    start = 100 * math.log(floater / largest) / math.log(small / largest) if hide else 0.0
    return Hiding((far, near), (largest, small), max(0, math.floor(start)))


def _sizes(gaussians: Gaussians) -> Tensor:
    """(N,) the longest axes."""
    return gaussians.log_scales.detach().amax(1).exp()


def _quantile(values: Tensor, share: float) -> float:
    values = values[values.isfinite()]
    return float(values.quantile(share)) if len(values) else 0.0
