"""The lines that are printed about finished stages."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

_NAMED = 5  # photos that are listed one by one


def described(stage: str, result: dict[str, Any]) -> list[str]:
    """One line about the result of a stage, and lines of details."""
    return _LINES[stage](result)


def _photos(gathered: dict[str, Any]) -> list[str]:
    photos, left_out = gathered["photos"], gathered["left_out"]
    masks = sum(bool(photo.get("mask")) for photo in photos)
    line = f"{len(photos)} photos" + (f" ({masks} with masks)" if masks else "")
    if left_out:
        line += f", {len(left_out)} skipped"
    notes = gathered.get("notes", [])
    return [line, *notes, *_listed([f"{each['photo']}: {each['reason']}" for each in left_out])]


def _poses(sfm: dict[str, Any]) -> list[str]:
    lost = sfm["unregistered"]
    placed = len(sfm["registered"])
    line = (
        f"{placed} of {placed + len(lost)} photos placed, {sfm['points']:,} points, "
        f"reprojection error {sfm['reprojection_error']:.2f} px"
    )
    details = []
    if len(sfm["sub_models"]) > 1:
        sizes = ", ".join(map(str, sfm["sub_models"]))
        details.append(
            f"the photos form {len(sfm['sub_models'])} groups without common points ({sizes} "
            "photos); the largest group is used"
        )
    if sfm.get("zooms"):
        details.append(f"the photos have {sfm['zooms']}: each group of them has its own lens")
    if sfm.get("fisheye"):
        details.append(sfm["fisheye"])
    if len(sfm["attempts"]) > 1:
        details.append("attempts: " + "; ".join(sfm["attempts"]))
    return [line, *details, *_listed([f"{name}: {why}" for name, why in lost.items()])]


def _images(undistorted: dict[str, Any]) -> list[str]:
    sizes = sorted(undistorted["sizes"], key=lambda size: -size[2])
    width, height, _ = sizes[0]
    others = f" and {len(sizes) - 1} other sizes" if len(sizes) > 1 else ""
    line = f"{undistorted['images']} images of {width}x{height}{others}"
    line += ", lens distortion removed" if undistorted["resampled"] else ""
    return [line + (f", {undistorted['masks']} masks" if undistorted["masks"] else "")]


def _scene(trained: dict[str, Any]) -> list[str]:
    known = trained["psnr"] is not None
    quality = f", PSNR {trained['psnr']:.2f} dB at {trained['size']}" if known else ""
    return [f"{trained['iteration']} steps{quality}"]


def _all(trained: dict[str, Any]) -> list[str]:
    if not trained["steps"]:
        return [f"no last part with the held-out photos: {trained['why_not']}"]
    photos = photos_of_last_part(trained["photos"], trained.get("left_out", 0))
    return [f"{trained['steps']} more steps with {photos}; the PSNR is that of the scene before"]


def photos_of_last_part(used: int, left_out: int) -> str:
    """The photos of the last part of the training; photos that it leaves out are not explained."""
    if not left_out:
        return f"all {used} photos"
    others = "the other" if left_out == 1 else "the others"
    return f"{used} of {used + left_out} photos (the scene does not explain {others})"


def _video(written: dict[str, Any]) -> list[str]:
    files = " and ".join(written["files"])
    width, height = written["size"]
    return [f"{files}: {written['frames']} frames {width}x{height}"]


def _levels(written: dict[str, Any]) -> list[str]:
    counts = " > ".join(f"{count:,}" for count in written["gaussians"])
    return [f"{counts} Gaussians, {written['bytes'] / 1e6:,.1f} MB"]


def _listed(lines: list[str]) -> list[str]:
    more = len(lines) - _NAMED
    return lines[:_NAMED] + ([f"and {more} more, see dataset_report.html"] if more > 0 else [])


_LINES: dict[str, Callable[[dict[str, Any]], list[str]]] = {
    "demo": lambda taken: [f"{taken['photos']} photos of a synthetic scene"],
    "photos": _photos,
    "poses": _poses,
    "images": _images,
    "report": lambda written: [written["file"]],
    "scene": _scene,
    "pictures": lambda rendered: ["test views rendered"],
    "all": _all,
    "video": _video,
    "levels": _levels,
}
