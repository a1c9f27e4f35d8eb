"""The lines that are printed about finished stages."""

from collections.abc import Callable, Iterable
from typing import Any

from snowsplat.util.messages import Message, as_message, message, plural

_NAMED = 5  # photos that are listed one by one


def described(stage: str, result: dict[str, Any]) -> list[Message]:
    """One line about the result of a stage, and lines of details."""
    return _LINES[stage](result)


def _photos(gathered: dict[str, Any]) -> list[Message]:
    photos, left_out = gathered["photos"], gathered["left_out"]
    line = message("{photos} photos", photos=len(photos))
    if masks := sum(bool(photo.get("mask")) for photo in photos):
        line = message("{photos} ({masks} with masks)", photos=line, masks=masks)
    if left_out:
        line = message("{photos}, {skipped} skipped", photos=line, skipped=len(left_out))
    notes = map(as_message, gathered.get("notes", []))
    return [line, *notes, *_listed((each["photo"], each["reason"]) for each in left_out)]


def _poses(sfm: dict[str, Any]) -> list[Message]:
    lost = sfm["unregistered"]
    placed = len(sfm["registered"])
    line = message(
        "{placed} of {all} photos placed, {points:,} points, reprojection error {error:.2f} px",
        placed=placed,
        all=placed + len(lost),
        points=sfm["points"],
        error=sfm["reprojection_error"],
    )
    details = []
    if len(sfm["sub_models"]) > 1:
        details.append(
            message(
                "the photos form {groups} groups without common points ({sizes} photos); the "
                "largest group is used",
                groups=len(sfm["sub_models"]),
                sizes=sfm["sub_models"],
            )
        )
    if sfm.get("zooms"):
        zooms = sfm["zooms"]
        details.append(
            message("the photos have {zooms}: each group of them has its own lens", zooms=zooms)
        )
    if sfm.get("fisheye"):
        details.append(as_message(sfm["fisheye"]))
    if len(sfm["attempts"]) > 1:
        details.append(message("attempts: {attempts}", attempts="; ".join(sfm["attempts"])))
    return [line, *details, *_listed(lost.items())]


def _images(undistorted: dict[str, Any]) -> list[Message]:
    sizes = sorted(undistorted["sizes"], key=lambda size: -size[2])
    width, height, _ = sizes[0]
    count = undistorted["images"]
    line = message("{n} images of {width}x{height}", n=count, width=width, height=height)
    if len(sizes) > 1:
        line = message("{images} and {n} other sizes", images=line, n=len(sizes) - 1)
    if undistorted["resampled"]:
        line = message("{images}, lens distortion removed", images=line)
    if undistorted["masks"]:
        line = message("{images}, {masks} masks", images=line, masks=undistorted["masks"])
    return [line]


def _scene(trained: dict[str, Any]) -> list[Message]:
    steps = message("{steps} steps", steps=trained["iteration"])
    if trained["psnr"] is None:
        return [steps]
    psnr, size = trained["psnr"], trained["size"]
    return [message("{steps}, PSNR {psnr:.2f} dB at {size}", steps=steps, psnr=psnr, size=size)]


def _all(trained: dict[str, Any]) -> list[Message]:
    if not trained["steps"]:
        why = as_message(trained["why_not"])
        return [message("no last part with the held-out photos: {why}", why=why)]
    photos = photos_of_last_part(trained["photos"], trained.get("left_out", 0))
    return [
        message(
            "{steps} more steps with {photos}; the PSNR is that of the scene before",
            steps=trained["steps"],
            photos=photos,
        )
    ]


def photos_of_last_part(used: int, left_out: int) -> Message:
    """The photos of the last part of the training; photos that it leaves out are not explained."""
    if not left_out:
        return message("all {used} photos", used=used)
    return plural(
        "{used} of {all} photos (the scene does not explain the other)",
        "{used} of {all} photos (the scene does not explain the others)",
        n=left_out,
        used=used,
        all=used + left_out,
    )


def _video(written: dict[str, Any]) -> list[Message]:
    width, height = written["size"]
    return [
        message(
            "{files}: {frames} frames {width}x{height}",
            files=written["files"],
            frames=written["frames"],
            width=width,
            height=height,
        )
    ]


def _levels(written: dict[str, Any]) -> list[Message]:
    counts = " > ".join(f"{count:,}" for count in written["gaussians"])
    return [message("{counts} Gaussians, {mb:,.1f} MB", counts=counts, mb=written["bytes"] / 1e6)]


def _listed(photos: Iterable[tuple[str, Any]]) -> list[Message]:
    lines = [message("{photo}: {why}", photo=name, why=as_message(why)) for name, why in photos]
    if (more := len(lines) - _NAMED) > 0:
        lines[_NAMED:] = [message("and {more} more, see dataset_report.html", more=more)]
    return lines


_LINES: dict[str, Callable[[dict[str, Any]], list[Message]]] = {
    "demo": lambda taken: [message("{n} photos of a synthetic scene", n=taken["photos"])],
    "photos": _photos,
    "poses": _poses,
    "images": _images,
    "report": lambda written: [Message(written["file"])],
    "scene": _scene,
    "pictures": lambda rendered: [message("test views rendered")],
    "all": _all,
    "video": _video,
    "levels": _levels,
}
