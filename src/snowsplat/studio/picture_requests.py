"""Requests for pictures: the photos of a scene, a small picture of it, the map of its cameras."""

import asyncio
import io
import math
from pathlib import Path
from typing import Any

from PIL import ImageOps
from starlette.requests import Request
from starlette.responses import Response

from snowsplat.data.photos.suffixes import PHOTO_SUFFIXES, VIDEO_SUFFIXES
from snowsplat.project.project import Project
from snowsplat.project.site_folder import SiteFolder
from snowsplat.project.studio_scene import StudioScene
from snowsplat.studio.given_photos import find_given, first_given, given_photos
from snowsplat.studio.library import UnknownScene
from snowsplat.studio.requests import File, SceneRoutes, Studio
from snowsplat.util.errors import UserError
from snowsplat.util.safe_json import is_file, printable

_PHOTOS = 120  # of a job, of which small pictures are shown
_SMALL = 320  # pixels of their longer side
#: Of photos, videos and zip files.
SUFFIXES = PHOTO_SUFFIXES | VIDEO_SUFFIXES | {".zip"}


async def picture(studio: Studio, request: Request, scene: StudioScene) -> Any:
    picture = await asyncio.to_thread(picture_of, scene)
    if picture is None:
        raise UnknownScene("there is no picture yet")
    return Response(await asyncio.to_thread(small_jpeg, picture), media_type="image/jpeg")


async def photos(studio: Studio, request: Request, scene: StudioScene) -> Any:
    return await asyncio.to_thread(photo_list, scene)


async def photo(studio: Studio, request: Request, scene: StudioScene) -> Any:
    shown = await asyncio.to_thread(shown_photos, scene)
    number = request.path_params["number"]
    if number >= len(shown):
        raise UnknownScene("there is no such photo")
    return Response(await asyncio.to_thread(small_jpeg, shown[number]), media_type="image/jpeg")


async def given(studio: Studio, request: Request, scene: StudioScene) -> Any:
    photos = await asyncio.to_thread(given_photos, scene)
    return [{"name": photo.name, "out": photo.out} for photo in photos]


async def given_photo(studio: Studio, request: Request, scene: StudioScene) -> Any:
    found = await asyncio.to_thread(find_given, scene, request.path_params["photo"])
    try:
        return Response(await asyncio.to_thread(small_jpeg, found.path), media_type="image/jpeg")
    except UserError:  # a damaged photo is listed, without a picture
        return Response(status_code=204)


async def map_of(studio: Studio, request: Request, scene: StudioScene) -> Any:
    policy = "sandbox; default-src 'none'; style-src 'unsafe-inline'"
    kept = {"Content-Disposition": "attachment"}  # <img> shows it; nobody opens it as a page
    return File(scene.map, **{"Content-Security-Policy": policy}, **kept)


ROUTES: SceneRoutes = (
    ("/picture", "GET", picture),  # a small picture of it
    ("/photos", "GET", photos),  # its photos, and which have a pose
    ("/photos/{number:int}", "GET", photo),  # a small one
    ("/given", "GET", given),  # the photos that were given, and which are left out
    ("/given/{photo:path}", "GET", given_photo),  # a small one
    ("/map", "GET", map_of),  # the cameras and points from above
)


def photo_list(scene: StudioScene) -> list[dict[str, Any]]:
    """The names of the photos that are shown, and whether they have a pose so far."""
    shown, placed = shown_photos(scene), scene.state().get("placed")
    if placed is None:
        return [{"name": path.name, "placed": True} for path in shown]
    names, folder = set(placed), Project.open(scene.made).dataset.photos
    inside = ((path.name, path.relative_to(folder).as_posix()) for path in shown)
    return [{"name": name, "placed": path in names} for name, path in inside]


def shown_photos(scene: StudioScene) -> list[Path]:
    """The photos of the dataset: those with a pose as soon as they are known, before that all."""
    dataset = Project.open(scene.made).dataset
    # While poses are estimated, the images of an earlier job may still be there.
    early = "placed" in scene.state()
    for folder in (dataset.photos,) if early else (dataset.images, dataset.photos):
        if folder.is_dir():
            found = sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES)
            step = max(1, math.ceil(len(found) / _PHOTOS))
            return found[::step]
    return []


def picture_of(scene: StudioScene) -> Path | None:
    """Of the site; before that a rendered test view, or a photo."""
    poster = SiteFolder(scene.site).poster()
    if poster is not None and is_file(poster):
        return poster
    training = Project.open(scene.made).training
    views = training.rendered_views() if training else []
    return next(iter([*views[:1], *shown_photos(scene)[:1]]), None) or first_given(scene)


def small_jpeg(path: Path) -> bytes:
    """A small picture as a JPEG file. Raises UserError: the file is no photo."""
    from snowsplat.sfm.ingest.photos.photo_files import open_image  # HEIC, too

    try:
        with open_image(path) as photo:
            photo.draft("RGB", (2 * _SMALL, 2 * _SMALL))  # faster JPEG decoding
            small = ImageOps.exif_transpose(photo)
            small.thumbnail((_SMALL, _SMALL))
            file = io.BytesIO()
            small.convert("RGB").save(file, "JPEG", quality=80)
            return file.getvalue()
    except Exception:  # anything that Pillow raises for a damaged file
        raise UserError("{name}: cannot be shown", name=printable(path.name)) from None
