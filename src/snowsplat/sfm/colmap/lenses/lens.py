"""The lens of each camera: how an attempt begins, and whether the result is possible.

Bundle adjustment determines a lens only if the photos do. If the camera moves forward, or if the
photos are few, then several focal lengths explain the matches equally well, and the estimate is
arbitrary: the poses are bent, although the reprojection error is small. So an estimate is compared
with what is known about lenses (`lens_findings`), and with the focal length in EXIF.

An estimate in doubt is compared with a model whose focal length is held (`settle_lens`). If this
model agrees equally well with the matches, then the photos do not determine the focal length, and
the held one is better. Otherwise the photos contradict it, and the estimate is right.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from snowsplat.data.judge.lens_check import Finding, lens_findings
from snowsplat.sfm.colmap.options import PANORAMA_MODEL
from snowsplat.sfm.ingest.photo import Photo
from snowsplat.util.messages import Message, message

# With fewer photos, the eight parameters of the camera model OPENCV are not well determined.
_MIN_PHOTOS_FOR_OPENCV = 8
#: Focal length of photos without EXIF, divided by the longest side: that of a 29 mm lens on 35 mm
#: film. It is between the values for the photos of a phone and for its videos, which are cropped.
GUESSED_FOCAL = 0.8
#: The same for a fisheye lens: its longest side spans 115°.
GUESSED_FISHEYE = 0.5
# A lens whose picture is a disc spans about this angle: 180° to 220°.
_CIRCLE = 190.0
# Models without coefficients; a fisheye lens then begins without one, too.
_EQUIDISTANT = ("SIMPLE_FISHEYE", "FISHEYE", "SIMPLE_PINHOLE")
# A fisheye lens sees behind itself by this angle at most. Degrees from the axis.
_WIDEST_HALF = 140.0
# Directions in which the distortion of a fisheye lens is examined. In COLMAP, directions at 90° or
# more from the axis have no pixels.
_MAX_ANGLE = 89.0
#: The camera models whose coefficients are k₁, k₂, p₁, p₂ and others, in this order.
POLYNOMIAL = ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
# A lens that is no fisheye moves pixels inwards by at most this share.
_MAX_BARREL = 0.28
# An ordinary lens changes the distance of a pixel from the centre by at most this share, in
# addition to the difference between a pinhole camera and a fisheye lens (r = f θ).
_MAX_DISPLACEMENT = 0.1
# An ordinary lens enlarges no part of the photo by more than this factor, compared with its centre.
_MAX_STRETCH = 1.3
# An ordinary lens moves pixels outwards or inwards. If it does both ("moustache" distortion), the
# second one compensates the first one by at most this share of the distance from the centre.
_MAX_MOUSTACHE = 0.02
# Two focal lengths agree equally well with the matches if the reprojection errors differ by less
#: than this share. Small systematic errors (rolling shutter, things that move) have this effect.
_EQUAL_ERROR = 0.05
# A possible lens is used instead of an impossible one up to this factor between the errors.
_MAX_WORSE = 2.0
#: Bundle adjustment ends when an iteration reduces the cost by less than this share.
TOLERANCE = 1e-4
# The estimated focal length is in doubt if it differs from that in EXIF by more than this share.
_NEAR_EXIF = 0.1
_FOLDED = message("the lens distortion is not one-to-one over the whole photo")


@dataclass(frozen=True)
class Lens:
    """How the cameras of an attempt begin, and what the mapper may change."""

    # A camera model of COLMAP; "auto": OPENCV if enough photos share a camera to determine its
    # eight parameters and ``held`` is false, else SIMPLE_RADIAL.
    model: str = "auto"
    held: bool = False  # the focal length is not changed
    exif: bool = True  # the focal length is that in EXIF, where known
    # Those with which cameras without EXIF begin, in pixels, by camera id; the others begin with a
    # guess.
    focals: Mapping[int, float] = field(default_factory=dict)
    fisheyes: frozenset[int] = frozenset()

    @property
    def any_fisheye(self) -> bool:
        return bool(self.fisheyes) or is_fisheye(self.model)

    @property
    def detailed(self) -> list[str]:
        """The camera models that `settle_lens` tries, the one with the most parameters first."""
        return ["auto", "SIMPLE_RADIAL", "SIMPLE_PINHOLE"] if self.model == "auto" else [self.model]

    @property
    def description(self) -> str:
        """As text for users; empty for the first choice."""
        parts = ["as a fisheye lens"] if self.fisheyes else []
        parts += ["several focal lengths"] if self.focals and not self.any_fisheye else []
        parts += ["a fixed focal length"] if self.held else []
        return " and ".join(parts if self.exif else [*parts, "without the focal length in EXIF"])


def is_fisheye(model: str) -> bool:
    """Whether a camera model of COLMAP measures angles: its pixels may be at 90° to the axis."""
    return model.endswith("FISHEYE")


def camera_ids(photos: Sequence[Photo]) -> list[int]:
    """The camera id of each photo: 1, 2, … in the order of the groups."""
    # Photos of a group normally have the same size. If not, they need separate cameras.
    keys = [(photo.group, photo.width, photo.height, photo.panorama) for photo in photos]
    ids = {key: number for number, key in enumerate(sorted(set(keys)), start=1)}
    return [ids[key] for key in keys]


def cameras_of(photos: Sequence[Photo], lens: Lens) -> list[pycolmap.Camera]:
    """The camera of each group of photos, in the order of `camera_ids`.

    A fisheye lens begins with at most one coefficient (see `with_all_parameters`). COLMAP verifies
    pairs of its photos only if a focal length is given, which may be inexact.
    """
    cameras = []
    known = exif_focals(photos) if lens.exif else {}
    ids = camera_ids(photos)
    for number, photo in sorted(dict(zip(ids, photos, strict=True)).items()):
        size = photo.width, photo.height
        if photo.panorama:  # it has no parameter that could be estimated
            camera = pycolmap.Camera(model=PANORAMA_MODEL, width=size[0], height=size[1])
            camera.camera_id, camera.params = number, size
            camera.has_prior_focal_length = True
            cameras.append(camera)
            continue
        model, guess = lens.model, GUESSED_FOCAL
        if number in lens.fisheyes or is_fisheye(model):
            model = "SIMPLE_FISHEYE" if model in _EQUIDISTANT else "SIMPLE_RADIAL_FISHEYE"
            guess = GUESSED_FISHEYE
        elif model == "auto":
            enough = ids.count(number) >= _MIN_PHOTOS_FOR_OPENCV and not lens.held
            model = "OPENCV" if enough else "SIMPLE_RADIAL"
        focal = known.get(number, lens.focals.get(number, guess * max(size)))
        camera = pycolmap.Camera.create_from_model_name(number, model, focal, *size)
        camera.has_prior_focal_length = number in known or lens.any_fisheye
        cameras.append(camera)
    return cameras


def with_all_parameters(
    model: pycolmap.Reconstruction, photos: Sequence[Photo], lens: Lens, refine: Refine, held: bool
) -> pycolmap.Reconstruction:
    """``model`` with all parameters of its fisheye lenses; without fisheye lenses, ``model``.

    The parameters of OPENCV_FISHEYE are undetermined in a model of a few photos, and bundle
    adjustment would bend it. So they are estimated at the end. If the lens is only a guess, they
    are not used where they would be impossible.
    """
    cameras, chosen = camera_ids(photos), []
    for number in used_cameras(model):
        camera, name = model.cameras[number], lens.model
        if name == "auto":
            enough = cameras.count(number) >= _MIN_PHOTOS_FOR_OPENCV
            name = "OPENCV_FISHEYE" if enough else camera.model_name
        if is_fisheye(camera.model_name) and name != camera.model_name:
            chosen.append(_convert(camera, name))
    if not chosen:
        return model
    made = refine(model, chosen, held)
    return model if lens.model == "auto" and _impossible(made) else made


def _convert(camera: pycolmap.Camera, model: str) -> pycolmap.Camera:
    """A camera in another ``model``; of the coefficients, those that both models have first."""
    size, focal = (camera.width, camera.height), camera.mean_focal_length()
    made = pycolmap.Camera.create_from_model_name(camera.camera_id, model, focal, *size)
    params = made.params.copy()
    params[list(made.principal_point_idxs())] = camera.principal_point_x, camera.principal_point_y
    for target, source in zip(made.extra_params_idxs(), camera.extra_params_idxs(), strict=False):
        params[target] = camera.params[source]  # the first coefficient is that of θ³, or of r²
    made.params = params
    return made


def exif_focals(photos: Sequence[Photo]) -> dict[int, float]:
    """The focal length of each camera in pixels, from EXIF; cameras without are left out."""
    return focals_by_camera(photos, {i: p.focal for i, p in enumerate(photos, 1) if p.focal})


def focals_by_camera(photos: Sequence[Photo], focals: Mapping[int, float]) -> dict[int, float]:
    """The median focal length of the photos of each camera; ``focals`` by image id."""
    values: dict[int, list[float]] = {}
    for image_id, camera in enumerate(camera_ids(photos), 1):
        if image_id in focals:
            values.setdefault(camera, []).append(focals[image_id])
    return {camera: float(np.median(known)) for camera, known in values.items()}


def circle_focals(photos: Sequence[Photo]) -> dict[int, float]:
    """The focal length in pixels of each camera whose picture is a disc; others are left out.

    It is that of an equidistant fisheye lens whose disc spans `_CIRCLE`.
    """
    per_pixel = 1 / np.radians(_CIRCLE / 2)
    circles = {i: p.circle * per_pixel for i, p in enumerate(photos, 1) if p.circle is not None}
    return focals_by_camera(photos, circles)


def pixels_per_radian(camera: pycolmap.Camera) -> float:
    """The mean focal length in pixels; of a panorama, the resolution at its equator."""
    if camera.is_spherical():
        return float(camera.width / (2 * np.pi))
    return camera.mean_focal_length()


def findings_of(camera: pycolmap.Camera) -> list[Finding]:
    """What is wrong with an estimated lens."""
    if camera.is_spherical():
        return []
    fx, fy = camera.focal_length_x, camera.focal_length_y
    cx, cy = camera.principal_point_x, camera.principal_point_y
    found = lens_findings(camera.width, camera.height, fx, fy, cx, cy)
    if is_fisheye(camera.model_name):
        found = [finding for finding in found if finding.about != "field of view"]
        reason = _implausible_fisheye(camera)
    else:
        reason = _implausible_distortion(camera)
    if reason:
        return [*found, Finding("distortion", reason, impossible=True)]
    moved = barrel(camera)
    if moved < -_MAX_BARREL:
        found.append(
            Finding(
                "distortion",
                message(
                    "the lens distortion moves pixels at the border by {moved:.0%}, as a fisheye "
                    "lens does",
                    moved=moved,
                ),
                message("if it is one, state the camera model OPENCV_FISHEYE"),
            )
        )
    return found


def _implausible_fisheye(camera: pycolmap.Camera) -> Message | None:
    """Why a fisheye lens is not that of a camera; None: it is plausible."""
    half = 0.5 * min(camera.width, camera.height) / camera.mean_focal_length()
    if half > np.radians(_WIDEST_HALF):
        return message(
            "a focal length of {fx:.5g} pixels for photos of {width}x{height} is a field of view "
            "of {angle:.0f}°",
            fx=camera.mean_focal_length(),
            width=camera.width,
            height=camera.height,
            angle=np.degrees(2 * half),
        )
    angle, turn = np.radians(np.arange(0.5, _MAX_ANGLE, 0.5)), np.arange(16) * (2 * np.pi / 16)
    sine, cosine = np.sin(angle)[:, None], np.cos(angle)[:, None]
    rays = np.stack([sine * np.cos(turn), sine * np.sin(turn), cosine + 0 * turn], -1)
    pixels = np.asarray(camera.img_from_cam(rays.reshape(-1, 3))).reshape(*rays.shape[:2], 2)
    inside = np.all((pixels >= 0) & (pixels <= [camera.width, camera.height]), axis=-1)
    centre = camera.principal_point_x, camera.principal_point_y
    radius = np.linalg.norm(pixels - centre, axis=-1)
    # A distortion that folds moves pixels back into the photo.
    if np.any(inside[:-1] & ~(radius[1:] > radius[:-1])):
        return _FOLDED
    return None


def barrel(camera: pycolmap.Camera) -> float:
    """The share by which a polynomial distortion moves pixels at the border; negative: inwards."""
    if camera.model_name not in POLYNOMIAL:
        return 0.0
    ideal = _border(camera)
    fx, fy = camera.focal_length_x, camera.focal_length_y
    corner = np.array([[0.0, 0.0], [camera.width, camera.height]])
    centre = np.array([camera.principal_point_x, camera.principal_point_y])
    distorted = np.linalg.norm((corner - centre) / (fx, fy), axis=1).max()
    return float(distorted / np.linalg.norm(ideal, axis=1).max() - 1)


def _implausible_distortion(camera: pycolmap.Camera) -> Message | None:
    """Why the distortion is not that of a lens; None: it is plausible. Fisheye models and
    models without distortion are plausible."""
    if not camera.is_perspective_pinhole() or camera.is_undistorted():
        return None
    ideal = _border(camera)
    if not np.isfinite(ideal).all():
        return _FOLDED
    # Along rays from the principal point to the border, in units of the focal length.
    steps = np.linspace(0.0, 1.0, 33)[1:]
    rays = np.concatenate([ideal[:, None] * steps[:, None], np.ones((len(ideal), 32, 1))], 2)
    pixels = np.asarray(camera.img_from_cam(rays.reshape(-1, 3))).reshape(len(ideal), 32, 2)
    focal = np.array([camera.focal_length_x, camera.focal_length_y])
    centre = np.array([camera.principal_point_x, camera.principal_point_y])
    distorted = np.linalg.norm((pixels - centre) / focal, axis=2)
    radius = np.linalg.norm(ideal, axis=1)[:, None] * steps
    slope = np.diff(distorted, axis=1) / np.diff(radius, axis=1)
    if not np.isfinite(slope).all() or slope.min() <= 0:
        return _FOLDED
    displaced = distorted / radius - 1
    fisheye = np.arctan(radius) / radius - 1
    if displaced.max() > _MAX_DISPLACEMENT or (displaced - fisheye).min() < -_MAX_DISPLACEMENT:
        worst = max(displaced.min(), displaced.max(), key=abs)
        return message("the lens distortion moves pixels at the border by {moved:.0%}", moved=worst)
    rise, fall = displaced.max(1) - displaced[:, 0], displaced.max(1) - displaced[:, -1]
    if np.minimum(rise, fall).max() > _MAX_MOUSTACHE:
        return message(
            "the lens distortion moves pixels outwards by {rise:.1%}, but those at the border "
            "inwards",
            rise=rise.max(),
        )
    if slope.max() > _MAX_STRETCH:
        return message(
            "the lens distortion enlarges a part of the photo {times:.1f} times", times=slope.max()
        )
    return None


def _border(camera: pycolmap.Camera) -> NDArray[np.floating[Any]]:
    """(N, 2) points on the border of the photo, in the ideal image plane; NaN if undefined."""
    along = np.linspace(0.0, 1.0, 9)
    sides = [(along, 0 * along), (along, 0 * along + 1), (0 * along, along), (0 * along + 1, along)]
    photo = np.concatenate([np.stack(side, 1) for side in sides]) * (camera.width, camera.height)
    return np.asarray(camera.cam_from_img(photo), np.float64).reshape(-1, 2)


@dataclass(frozen=True)
class Settled:
    """A model whose lens is possible."""

    model: pycolmap.Reconstruction | None  # None: no possible lens agrees with the matches
    held: bool  # whether the focal length is held from now on
    notes: list[Message]  # what is in doubt about the lens


#: `Mapping.with_cameras`.
Refine = Callable[
    [pycolmap.Reconstruction, Sequence[pycolmap.Camera], bool], pycolmap.Reconstruction
]


def settle_lens(
    model: pycolmap.Reconstruction, photos: Sequence[Photo], lens: Lens, refine: Refine
) -> Settled:
    """Replace a lens in doubt by a possible one.

    A lens that was held during the mapping is always in doubt.

    Args:
        model: from the mapper; it is not changed.
        lens: that of the attempt which made ``model``.
    """
    known = exif_focals(photos)
    if not (lens.held or _doubts(model, known)):
        return Settled(model, False, [])

    def refined(held: bool) -> pycolmap.Reconstruction:
        """With the most detailed lens that is possible; if there is none, with the last one."""
        for name in lens.detailed:
            cameras = cameras_of(photos, replace(lens, model=name, held=False))
            made = refine(model, cameras, held)
            if not _impossible(made):
                break
        return made

    free, held = refined(False), refined(True)
    most = _MAX_WORSE if _impossible(free) else 1 + _EQUAL_ERROR
    if not _impossible(held) and misfit(held) <= most * misfit(free):
        return Settled(held, True, [])
    return Settled(None if _impossible(free) else free, False, _doubts(free, known))


def _doubts(model: pycolmap.Reconstruction, known: Mapping[int, float]) -> list[Message]:
    """What is wrong or in doubt about the lenses of a model."""
    found = []
    for number in used_cameras(model):
        camera = model.cameras[number]
        found += [finding.sentence for finding in findings_of(camera)]
        exif, focal = known.get(number), camera.mean_focal_length()
        if exif and not 1 / (1 + _NEAR_EXIF) < focal / exif < 1 + _NEAR_EXIF:
            found.append(
                message(
                    "the focal length in EXIF ({exif:.0f} pixels) does not agree with the photos "
                    "({focal:.0f} pixels); the latter is used",
                    exif=exif,
                    focal=focal,
                )
            )
    return list(dict.fromkeys(found))


def _impossible(model: pycolmap.Reconstruction) -> bool:
    return any(
        finding.impossible
        for number in used_cameras(model)
        for finding in findings_of(model.cameras[number])
    )


def used_cameras(model: pycolmap.Reconstruction) -> list[int]:
    """The ids of the cameras of photos that have a pose."""
    return sorted({model.image(image_id).camera_id for image_id in model.reg_image_ids()})


def misfit(model: pycolmap.Reconstruction) -> float:
    """The mean reprojection error in pixels / the number of observations.

    Bundle adjustment removes observations with large errors. So a model that agrees less well with
    the matches has larger errors, or fewer observations, or both.
    """
    count = model.compute_num_observations()
    return model.compute_mean_reprojection_error() / count if count else float("inf")


def robust_adjustment(
    threads: int, tolerance: float, scale: float
) -> pycolmap.BundleAdjustmentOptions:
    """Bundle adjustment with a Cauchy loss of this ``scale`` in pixels.

    It ends when an iteration reduces the cost by less than the share ``tolerance``.
    """
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.solver_options.num_threads = threads
    options.ceres.solver_options.function_tolerance = tolerance
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = scale
    return options
