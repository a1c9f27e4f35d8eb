"""A folder -> `Dataset`: selects the reader, and the file, size and split of each image."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from snowsplat.data.dataset import Dataset, Points, PosedImage, View
from snowsplat.data.files.listing import folders_of_maps
from snowsplat.data.files.masks import with_masks
from snowsplat.data.files.photo_files import warn_of_unusable
from snowsplat.data.frame.bounds import near_of, scene_extent
from snowsplat.data.frame.move_to_origin import move_to_origin
from snowsplat.data.hold_out import held_out_names
from snowsplat.data.image_sizes import ImageSize, with_sizes, with_smaller_copies
from snowsplat.data.lens.coverage import image_circle
from snowsplat.data.lens.lens import Lens
from snowsplat.data.lens.views import LensView, is_wide, lens_views
from snowsplat.data.maps.map_files import MAP_SUFFIXES
from snowsplat.data.photos.check_pixels import check_pixels
from snowsplat.data.photos.decode import ImageSource, load_thumbnail
from snowsplat.data.photos.image_loader import each_photo
from snowsplat.data.readers import read_poses
from snowsplat.project.training_folder import DatasetSettings
from snowsplat.scene.camera import Camera
from snowsplat.scene.origin import Origin
from snowsplat.util.errors import SettingError, UserError
from snowsplat.util.messages import Message
from snowsplat.util.names import first_names
from snowsplat.util.safe_json import is_file

logger = logging.getLogger(__name__)

# Values of ``resolution`` that divide the image size; any other value is a width.
_DIVISORS = (1, 2, 4, 8)
# Smallest width and height of a scaled image in pixels. A smaller size is rejected as a mistake.
_SMALLEST_SIDE = 16
# COLMAP places no photo by fewer points than this (`abs_pose_min_num_inliers`). Fewer are no
# reconstruction: other trainers insist on a file of points, so people write some. So many points
# are compared.
_FEWEST_PLACES, _PLACES = 30, 1000
# What programs add to the name of the photo of a map.
_MAP_ENDS = ("", "_depth", "_normal", "_aligned")
# To find the image circle of a lens: the number of photos, and their longer side in pixels.
_CIRCLE_PHOTOS, _CIRCLE_SIDE = 12, 400


def load_dataset(
    path: Path | str,
    *,
    images: str = "images",
    resolution: int | None = None,
    hold_out: int | None = 8,
    first_held_out: int = 0,
    test_list: Path | str | Sequence[str] | None = None,
) -> Dataset:
    """Read a dataset of posed images. Image headers are checked; pixels are not decoded.

    Args:
        path: a folder with a COLMAP model (``sparse/0`` …, binary or text) and images; a folder
            with ``transforms.json`` or ``transforms_train.json``; or such a JSON file; or the
            export of another program, see `snowsplat.data.readers`. The folder may contain depth
            and normal maps of the images, ``depths/IMG.png`` and ``normals/IMG.png`` (or TIFF, NPY,
            EXR).
        images: name of the folder of images.
        resolution: 1, 2, 4 or 8 divides the image size; the folders ``images_2`` … are used if
            they are complete. Any other number is a width in pixels to which wider images are
            scaled down. None or −1 keeps the size.
        hold_out: every ``hold_out``-th image in the natural order of names (img_9 before img_10)
            is held out for testing. If the dataset has its own split, this split is used instead.
            None: no image is held out, even if the dataset has its own split.
        first_held_out: index of the first of these images. 0 is the protocol of the papers. If
            there are not so many images, the middle one is held out; the only one is not.
        test_list: names of the test images, or a text file with one name per line. It replaces
            ``hold_out`` and the dataset's own split.

    Raises:
        UserError: ``path`` is not a dataset; a file is damaged; a camera has lens distortion; an
            image is missing, damaged, or does not have the size of its camera.
        SettingError: ``images`` is not the folder of the images, or ``resolution``, ``hold_out`` or
            ``first_held_out`` is invalid.
    """
    named: str | list[str] | None = None
    if test_list is not None:
        named = str(test_list) if isinstance(test_list, str | Path) else list(test_list)
    size = -1 if resolution is None else resolution
    return read_dataset(DatasetSettings(str(path), images, size, hold_out, first_held_out, named))


def read_dataset(settings: DatasetSettings) -> Dataset:
    """`load_dataset` with its arguments as one object."""
    return read_files(settings).dataset(settings.resolution)


@dataclass(frozen=True)
class DatasetFiles:
    """The files of a dataset, read and checked: they become a `Dataset` at any resolution.

    Attributes:
        images: each image, and the size of its file.
        circles: the radius of the image circle of each wide lens that has one in the photos.
        test_names: names of the images to hold out.
        origin, metres_per_unit: see `Dataset`.
    """

    root: Path
    images: list[tuple[PosedImage, ImageSize]]
    circles: Mapping[Lens, float]
    points: Points | None
    description: str | Message
    test_names: set[str]
    origin: Origin
    metres_per_unit: float | None

    def without(self, names: Sequence[str]) -> DatasetFiles:
        """The same files without some images; the others stay held out or not."""
        kept = [(image, size) for image, size in self.images if image.name not in names]
        return replace(self, images=kept)

    def dataset(self, resolution: int) -> Dataset:
        """The dataset at a resolution, see `load_dataset`; reads no file.

        Raises:
            SettingError: ``resolution`` is invalid.
            UserError: all images are held out, or cameras are not finite.
        """
        train: list[View] = []
        test: list[View] = []
        for image, size in self.images:
            views = _views(image, size, resolution, self.circles.get(image.lens))
            (test if image.name in self.test_names else train).extend(views)
        if not train:
            raise UserError(
                "{root}: all {images} images are held out for testing, so no image is left for "
                "training; hold out fewer or none",
                root=self.root,
                images=len(self.images),
            )
        points = None if self.points is None else self.points.xyz
        near = near_of([view.camera for view in [*train, *test]], points)
        return Dataset(
            train=_in_order(train, near),
            test=_in_order(test, near),
            points=self.points,
            extent=scene_extent([view.camera for view in train]),
            description=self.description,
            origin=self.origin,
            metres_per_unit=self.metres_per_unit,
        )


def _in_order(views: Sequence[View], near: float) -> list[View]:
    """The views sorted by name, with the near plane ``near``."""
    with_near = (replace(view, camera=replace(view.camera, near=near)) for view in views)
    return sorted(with_near, key=lambda view: view.name)


def read_files(settings: DatasetSettings) -> DatasetFiles:
    """Read and check the files of a dataset, once for several resolutions.

    ``settings``: a resolution of 2, 4 or 8 selects the folder ``images_2`` …; other values select
    the full size. The errors are those of `load_dataset`.
    """
    root, resolution = Path(settings.path), settings.resolution
    found = read_poses(root, settings.images)
    if found.points is not None and _are_placeholder(found.points):
        logger.warning(
            "%s: the points are at fewer than %d places: as if there were none",
            root,
            _FEWEST_PLACES,
        )
        found.points = None
    posed, points, origin = move_to_origin(found.images, found.points)
    folder = root.parent if root.is_file() else root
    posed = with_masks(folder, _with_maps(folder, posed))
    if resolution in _DIVISORS[1:]:
        posed = with_smaller_copies(posed, resolution)
    first = {image.name: image for image in reversed(posed)}
    if len(first) < len(posed):
        twice = [name for name, n in Counter(image.name for image in posed).items() if n > 1]
        logger.warning(
            "%s: has several images named %s; the first one is used", root, first_names(twice, 3)
        )
    sized = with_sizes(root, [image for image in posed if first[image.name] is image])
    posed = [image for image, _ in sized]
    _warn_of_cropped(posed)
    files = DatasetFiles(
        root=root,
        images=sized,
        test_names=held_out_names(
            posed, settings.hold_out, settings.first_held_out, settings.test_list
        ),
        circles=_circles(sized),
        points=points,
        description=found.description,
        origin=origin,
        metres_per_unit=found.metres_per_unit,
    )
    return files.without([*(settings.left_out or []), *(settings.damaged or [])])


def read_undamaged(settings: DatasetSettings) -> tuple[DatasetSettings, DatasetFiles]:
    """As `read_files`, without photos whose data are damaged, which the settings then name.

    All photos and masks are decoded, at a fraction of their size.

    Raises: UserError: also if at least half of the photos are damaged.
    """
    files = read_files(settings)

    def check(image: PosedImage) -> UserError | None:
        try:
            for path in filter(None, (image.path, image.mask)):
                check_pixels(path)
        except UserError as error:
            return error
        return None

    images = [image for image, _ in files.images]
    found = zip(images, each_photo(check, images), strict=True)
    errors = {image.name: error for image, error in found if error is not None}
    if not errors:
        return settings, files
    warn_of_unusable(files.root, errors, len(images) - len(errors))
    settings = replace(settings, damaged=[*(settings.damaged or []), *errors])
    return settings, files.without([*errors])


def _are_placeholder(points: Points) -> bool:
    sample = points.xyz[:: max(1, len(points) // _PLACES)]
    return len(sample.unique(dim=0)) < _FEWEST_PLACES


def _with_maps(folder: Path, posed: list[PosedImage]) -> list[PosedImage]:
    """The same images, with ``depths/IMG.png`` and ``normals/IMG.png`` of the folder, or
    ``IMG.jpg.png``, or files of other formats, as maps of ``IMG.jpg``."""
    depths, normals = folders_of_maps(folder)
    if depths is not None:
        posed = [replace(image, depth=image.depth or _map_of(image, depths)) for image in posed]
    if normals is not None:
        posed = [replace(image, normals=_map_of(image, normals)) for image in posed]
    for maps, used in (
        (depths, any(image.depth for image in posed)),
        (normals, any(image.normals for image in posed)),
    ):
        if maps is not None and not used:
            logger.warning("%s: none of its files has the name of a photo; not used", maps)
    return posed


def _map_of(image: PosedImage, folder: Path) -> Path | None:
    stems = (str(Path(image.file).with_suffix("")), image.file)
    names = (
        folder / (stem + end + suffix)
        for stem in stems
        for end in _MAP_ENDS
        for suffix in MAP_SUFFIXES
    )
    return next((name for name in names if is_file(name)), None)


def _circles(images: Sequence[tuple[PosedImage, ImageSize]]) -> dict[Lens, float]:
    """The radius in pixels of the image circle of each wide lens that has one; see `image_circle`.
    Decodes a few photos of each of these lenses."""
    # Photos may have a calibration each, of the same lens.
    kinds: dict[tuple[str, int, int], dict[Lens, list[ImageSource]]] = {}
    for image, size in images:
        if not (lens := image.lens).is_pinhole and is_wide(lens):
            source = ImageSource(image.path, size.width, size.height, size.oriented)
            kind = kinds.setdefault((lens.model, lens.width, lens.height), {})
            kind.setdefault(lens, []).append(source)
    circles: dict[Lens, float] = {}
    for lenses in kinds.values():
        photos = [photo for sources in lenses.values() for photo in sources]
        chosen = photos[:: -(-len(photos) // _CIRCLE_PHOTOS)]
        small = [load_thumbnail(photo, _CIRCLE_SIDE) for photo in chosen]
        radius = image_circle(next(iter(lenses)), small)
        if radius is not None:
            circles |= dict.fromkeys(lenses, radius)
    return circles


def _views(
    image: PosedImage, size: ImageSize, resolution: int, circle: float | None
) -> Iterator[View]:
    """The view of an image; of a wide lens, several views. All of them are without distortion."""
    maps = image.depth, image.depth_unit, image.depth_confidence, image.normals
    for view in [None] if image.lens.is_pinhole else _pinhole_views(image, circle):
        name, camera, width, height = image.name, image.camera, size.width, size.height
        if view is not None:
            width = max(1, round(view.width * width / view.lens.width))
            height = max(1, round(view.height * height / view.lens.height))
            pose = camera.cam_from_world
            if view.rotation is not None:
                pose = torch.tensor(view.rotation, dtype=pose.dtype) @ pose
            camera = Camera(view.width, view.height, *view.params, pose)
            name = f"{name}/{view.name}" if view.name else name
        width, height = _final_size(image, width, height, resolution)
        source = ImageSource(image.path, width, height, size.oriented, size.stored, view)
        mask = None
        if image.mask is not None:
            stored = 0 if view is None else size.stored
            mask = replace(source, path=image.mask, stored=stored)
        elif view is not None and view.partial:
            mask = replace(source, blank=True)
        yield View(name, camera.scaled(width, height), source, mask, *maps)


def _pinhole_views(image: PosedImage, circle: float | None) -> tuple[LensView, ...]:
    lens = image.lens
    try:
        return lens_views(lens, circle)
    except ValueError as error:
        shown = ", ".join(f"{value:.5g}" for value in lens.params)
        raise UserError(
            "{path}: the lens distortion ({model} {shown}) is not possible: {error}; correct the "
            "calibration",
            path=image.path,
            model=lens.model,
            shown=shown,
            error=error,
        ) from None


def _warn_of_cropped(posed: Sequence[PosedImage]) -> None:
    """Warn of lenses whose calibration is valid only near the centre of the photos."""
    cropped = [
        image
        for image in posed
        if not image.lens.is_pinhole and any(v.cropped for v in _pinhole_views(image, None))
    ]
    if cropped:
        logger.warning(
            "%s: the lens distortion (%s) is valid only near the centre of the photos, so %d of %d "
            "photos are cropped",
            cropped[0].path,
            cropped[0].lens.model,
            len(cropped),
            len(posed),
        )


def _final_size(image: PosedImage, width: int, height: int, resolution: int) -> tuple[int, int]:
    if resolution == -1:
        return width, height
    if resolution < 1:
        raise SettingError(
            "resolution",
            "{resolution} is not valid; use 1, 2, 4, 8 or a width",
            resolution=resolution,
        )
    if resolution in _DIVISORS:
        divisor = resolution / image.divided
    else:
        divisor = max(1.0, width / resolution)
    new_width, new_height = max(1, round(width / divisor)), max(1, round(height / divisor))
    if divisor > 1 and min(new_width, new_height) < _SMALLEST_SIDE:
        raise SettingError(
            "resolution",
            "{resolution} makes images of {new_width}x{new_height} pixels; use 1, 2, 4 or 8 to "
            "divide their size, or a larger width",
            resolution=resolution,
            new_width=new_width,
            new_height=new_height,
        )
    return new_width, new_height
