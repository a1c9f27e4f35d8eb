"""A folder -> `Dataset`: selects the reader, and the file, size and split of each image."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from snowsplat.data.colmap import find_models, find_models_below, read_colmap
from snowsplat.data.dataset import Dataset, Points, PosedImage, View, scene_extent
from snowsplat.data.files.masks import with_masks
from snowsplat.data.files.photo_files import photos_below
from snowsplat.data.frame.move_to_origin import moved_to_origin
from snowsplat.data.frame.near import near_of
from snowsplat.data.frame.placement import read_placement
from snowsplat.data.lens.circle import image_circle
from snowsplat.data.lens.lens import Lens
from snowsplat.data.lens.views import LensView, is_wide, lens_views
from snowsplat.data.maps.map_file import MAP_SUFFIXES
from snowsplat.data.photos.decode import (
    IMAGE_SUFFIXES,
    Header,
    ImageSource,
    load_thumbnail,
    read_header,
)
from snowsplat.data.readers import Export, find_export, read_export
from snowsplat.data.readers.projects import advice
from snowsplat.data.readers.transforms_json import find_transforms, read_transforms
from snowsplat.scene.camera import Camera
from snowsplat.scene.length import stored_metres
from snowsplat.scene.origin import Origin
from snowsplat.util.errors import SettingError, UserError
from snowsplat.util.natural_order import natural_key
from snowsplat.util.safe_json import is_file, quoted

logger = logging.getLogger(__name__)

# Values of ``resolution`` that divide the image size; any other value is a width.
_DIVISORS = (1, 2, 4, 8)
# Smallest width and height of a scaled image in pixels. A smaller size is rejected as a mistake.
_SMALLEST_SIDE = 16
# The largest ratio between the size of a camera and the size of its image file.
_LARGEST_FACTOR = 16
# To find the image circle of a lens: the number of photos, and their longer side in pixels.
_CIRCLE_PHOTOS, _CIRCLE_SIDE = 12, 400


class NoPosesError(UserError):
    """A folder has no camera poses, so it is not a dataset; it may have photos."""


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
            there are not so many images, the middle one is held out.
        test_list: names of the test images, or a text file with one name per line. It replaces
            ``hold_out`` and the dataset's own split.

    Raises:
        UserError: ``path`` is not a dataset; a file is damaged; a camera has lens distortion; an
            image is missing, damaged, or does not have the size of its camera.
        SettingError: ``images`` is not the folder of the images, or ``resolution``, ``hold_out`` or
            ``first_held_out`` is invalid.
    """
    return read_files(
        path,
        images=images,
        resolution=resolution,
        hold_out=hold_out,
        first_held_out=first_held_out,
        test_list=test_list,
    ).dataset(resolution)


@dataclass(frozen=True)
class DatasetFiles:
    """The files of a dataset, read and checked: they become a `Dataset` at any resolution.

    Attributes:
        images: each image, the header of its file, and the result of `_file_sizes`.
        circles: the radius of the image circle of each wide lens that has one in the photos.
        test_names: names of the images to hold out.
        origin, metres_per_unit: see `Dataset`.
    """

    root: Path
    images: list[tuple[PosedImage, Header, tuple[int, int, bool]]]
    circles: Mapping[Lens, float]
    points: Points | None
    description: str
    test_names: set[str]
    origin: Origin
    metres_per_unit: float | None

    def dataset(self, resolution: int | None) -> Dataset:
        """The dataset at a resolution, see `load_dataset`; reads no file.

        Raises:
            SettingError: ``resolution`` is invalid.
            UserError: all images are held out, or cameras are not finite.
        """
        train: list[View] = []
        test: list[View] = []
        for image, header, size in self.images:
            views = _views(image, header, size, resolution, self.circles)
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


def read_files(
    path: Path | str,
    *,
    images: str = "images",
    resolution: int | None = None,
    hold_out: int | None = 8,
    first_held_out: int = 0,
    test_list: Path | str | Sequence[str] | None = None,
) -> DatasetFiles:
    """Read and check the files of a dataset, once for several resolutions.

    ``resolution``: 2, 4 or 8 selects the folder ``images_2`` …; other values select the full size.

    The other arguments and the errors are those of `load_dataset`.
    """
    root = Path(path)
    posed, points, description, metres = _read(root, images)
    posed, points, origin = moved_to_origin(posed, points)
    folder = root.parent if root.is_file() else root
    posed = with_masks(folder, _with_maps(folder, posed))
    posed = _with_smaller_copies(posed, resolution)
    headers = [read_header(image.path) for image in posed]
    sizes = _file_sizes(posed, headers)
    for image, size in zip(posed, sizes, strict=True):
        if image.mask is not None:
            _check_mask(image.mask, size)
    count = Counter(image.name for image in posed)
    if len(count) < len(posed):
        repeated = next(name for name, n in sorted(count.items()) if n > 1)
        raise UserError(
            "{root}: has two images named {repeated}; remove one", root=root, repeated=repeated
        )
    _warn_of_cropped(posed)
    found = list(zip(posed, headers, sizes, strict=True))
    names = _test_names(posed, hold_out, first_held_out, test_list)
    return DatasetFiles(root, found, _circles(found), points, description, names, origin, metres)


@dataclass(frozen=True)
class _Poses:
    """What gives the poses of a dataset: COLMAP models, the largest first; transforms files; or an
    export. Only one of them is used."""

    models: list[Path]
    transforms: list[Path]
    export: Export | None


def _find_poses(root: Path, images: str, deep: bool = True) -> _Poses | None:
    """What gives the poses of the images in a folder, or of a file; None if there is nothing.
    ``deep``: also models in other folders than ``sparse``, which may be those of other photos."""
    export = find_export(root) if root.is_file() else None
    transforms = [] if export else find_transforms(root)
    models = find_models(root / "sparse")
    if deep and not transforms:
        models = models or find_models(root) or find_models(root / "colmap" / "sparse")
    # dense/0/sparse, sfm …
    if deep and not transforms and not (models and (root / images).is_dir()):
        models = find_models_below(root, images) or models
    if models:
        return _Poses(models, [], None)
    if transforms:
        return _Poses([], transforms, None)
    export = export or find_export(root)
    return _Poses([], [], export) if export and export.cameras else None


def _read(root: Path, images: str) -> tuple[list[PosedImage], Points | None, str, float | None]:
    """Posed images, points, a description, and the metres in a unit of them if that is known."""
    if not root.exists():
        raise UserError("{root}: no such folder", root=root)
    poses = _find_poses(root, images)
    if poses and poses.transforms:
        return *read_transforms(poses.transforms, images), None
    if poses and poses.export:
        return *read_export(root, poses.export, images), poses.export.kind.metres_per_unit
    if root.suffix.lower() == ".zip" and root.is_file():
        raise UserError(
            "{root}: is a zip file; unpack it and use its folder, or if there are only photos in "
            "it, run: snowsplat make {root} -o OUT",
            root=root,
        )
    if root.is_file():
        raise UserError("{root}: not a dataset; use its folder, or a transforms.json", root=root)
    if not poses or not ((root / images).is_dir() or photos_below(root)):
        parents = root.absolute().parents[:2]
        above = next((p for p in parents if _find_poses(p, images, deep=False)), None)
        if above is not None:
            raise UserError(
                "{root}: a part of a dataset; use the whole: {above}", root=root, above=above
            )
    if poses:
        placement = read_placement(root) if poses.models[0] == root / "sparse" / "0" else None
        metres = None if placement is None else stored_metres(placement.metres_per_unit)
        return *read_colmap(root, poses.models, images), metres
    if (known := advice(root)) is not None:
        raise NoPosesError(
            "{root}: no camera poses that can be read here; {known}", root=root, known=known
        )
    raise NoPosesError(
        "{root}: no camera poses here (neither sparse/0 of COLMAP nor transforms.json); to "
        "estimate the poses of photos, run: snowsplat sfm PHOTOS -o DATASET",
        root=root,
    )


def poses_in(root: Path) -> Path | None:
    """What gives the poses of the photos in a folder, relative to it, as sparse/0; or None."""
    try:
        poses = _find_poses(root, "images") if root.is_dir() else None
    except UserError:  # several datasets
        return None
    if poses is None:
        return None
    cameras = poses.export and poses.export.cameras
    return (cameras or [*poses.models, *poses.transforms][0]).relative_to(root)


def _with_maps(folder: Path, posed: list[PosedImage]) -> list[PosedImage]:
    """The same images, with ``depths/IMG.png`` and ``normals/IMG.png`` of the folder, or
    ``IMG.jpg.png``, or files of other formats, as maps of ``IMG.jpg``."""
    if (depths := folder / "depths").is_dir():
        posed = [replace(image, depth=image.depth or _map_of(image, depths)) for image in posed]
    if (normals := folder / "normals").is_dir():
        posed = [replace(image, normals=_map_of(image, normals)) for image in posed]
    return posed


def _map_of(image: PosedImage, folder: Path) -> Path | None:
    stems = (str(Path(image.file).with_suffix("")), image.file)
    names = (folder / (stem + suffix) for stem in stems for suffix in MAP_SUFFIXES)
    return next((name for name in names if is_file(name)), None)


def _with_smaller_copies(posed: list[PosedImage], resolution: int | None) -> list[PosedImage]:
    """For a resolution N of 2, 4 or 8: the same images from the folder ``images_N``.

    The images are returned unchanged for other resolutions, and if an image in this folder is
    missing or has another size.
    """
    if resolution not in _DIVISORS[1:]:
        return posed
    smaller = []
    for image in posed:
        if not image.folder.name:
            return posed
        folder = image.folder.with_name(f"{image.folder.name}_{resolution}")
        stem = str(Path(image.file).with_suffix(""))
        names = (image.file, *(stem + s for s in IMAGE_SUFFIXES), stem + ".JPG", stem + ".PNG")
        found = next((name for name in names if is_file(folder / name)), None)
        if found is None or not _is_copy(image.path, folder / found, resolution):
            if folder.is_dir():
                logger.warning(
                    "%s: not used, because %s %s; the large images are scaled instead",
                    folder,
                    image.file,
                    "is missing" if found is None else f"is not 1/{resolution} of the large image",
                )
            return posed
        smaller.append(replace(image, folder=folder, file=found, divided=resolution))
    return smaller


def _is_copy(large: Path, small: Path, factor: int) -> bool:
    header = read_header(small)
    return _is_divided(read_header(large), (header.width, header.height), factor)


def _is_divided(large: Header | Camera, size: tuple[int, int], factor: float) -> bool:
    """Whether ``size`` is the size of ``large``, divided by ``factor``."""
    # Sizes that are not divisible are rounded up by some tools and down by others.
    return abs(size[0] - large.width / factor) < 1 and abs(size[1] - large.height / factor) < 1


def _file_sizes(posed: list[PosedImage], headers: list[Header]) -> list[tuple[int, int, bool]]:
    """Width and height of each file, and whether to apply its EXIF orientation.

    The sizes are checked against the cameras. The images of a folder may be smaller or larger than
    the images that the poses were estimated from (for example ``images_4``, or a dataset that is
    distributed without the large images). The ratio of the sizes must be the same for all images of
    a folder. `_views` scales the intrinsics.
    """
    found = [_shrink_factor(image, header) for image, header in zip(posed, headers, strict=True)]
    usual: dict[Path, float] = {}  # the most frequent factor in each folder
    for folder in {image.folder for image in posed}:
        factors = [f for i, (f, _) in zip(posed, found, strict=True) if i.folder == folder and f]
        if factors:
            usual[folder] = Counter(sorted(factors)).most_common(1)[0][0]
    sizes = []
    for image, header, (factor, sideways) in zip(posed, headers, found, strict=True):
        size = (header.height, header.width) if sideways else (header.width, header.height)
        camera = image.camera
        if factor is None or not _is_divided(camera, size, usual[image.folder]):
            raise UserError(
                "{path}: is {width}x{height}, but its camera is {width2}x{height2}; use the "
                "images that the poses were estimated from, or scale all of them by one factor",
                path=image.path,
                width=header.width,
                height=header.height,
                width2=camera.width,
                height2=camera.height,
            )
        sizes.append((*size, sideways))
    for folder, factor in usual.items():
        if factor != 1 and not folder.name.endswith(f"_{factor:g}"):
            logger.warning(
                "%s: the images are %s of the size of their cameras; the cameras are scaled",
                folder,
                f"1/{factor:g}" if factor == round(factor) else f"{1 / factor:.4g}",
            )
    return sizes


def _shrink_factor(image: PosedImage, header: Header) -> tuple[float | None, bool]:
    """The image size of the camera divided by that of the file; whether to apply EXIF orientation.

    The factor is None if the size of the file does not match the camera. Like COLMAP, this ignores
    the EXIF orientation, unless the image matches its camera only with the orientation applied.
    """
    camera = image.camera
    for sideways in (False, True) if header.sideways else (False,):
        width, height = (header.height, header.width) if sideways else (header.width, header.height)
        if (width, height) == (camera.width, camera.height):
            return 1.0, sideways
        ratio = max(camera.width, camera.height) / max(width, height)
        if not 1 < max(ratio, 1 / ratio) <= _LARGEST_FACTOR:
            continue
        for factor in (max(2, round(ratio)), ratio):
            if _is_divided(camera, (width, height), factor):
                return float(factor), sideways
    return None, False


def _circles(
    images: Sequence[tuple[PosedImage, Header, tuple[int, int, bool]]],
) -> dict[Lens, float]:
    """The radius in pixels of the image circle of each wide lens that has one; see `image_circle`.
    Decodes a few photos of each of these lenses."""
    # Photos may have a calibration each, of the same lens.
    kinds: dict[tuple[str, int, int], dict[Lens, list[ImageSource]]] = {}
    for image, _, (width, height, sideways) in images:
        if (lens := image.lens) is not None and is_wide(lens):
            source = ImageSource(image.path, width, height, sideways)
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
    image: PosedImage,
    header: Header,
    size: tuple[int, int, bool],
    resolution: int | None,
    circles: Mapping[Lens, float],
) -> Iterator[View]:
    """The view of an image; of a wide lens, several views. All of them are without distortion."""
    width, height, sideways = size
    if image.lens is None:
        width, height = _final_size(image, width, height, resolution)
        mask = None
        if image.mask is not None:
            mask = ImageSource(image.mask, width, height, sideways)
        source = ImageSource(image.path, width, height, sideways, header.width * header.height)
        camera = image.camera.scaled(width, height)
        yield View(image.name, camera, source, mask, *_maps_of(image))
        return
    for view in _pinhole_views(image, image.lens, circles.get(image.lens)):
        yield _lens_view(image, view, header, size, resolution)


def _maps_of(image: PosedImage) -> tuple[Path | None, float, Path | None, Path | None]:
    return image.depth, image.depth_unit, image.depth_confidence, image.normals


def _pinhole_views(image: PosedImage, lens: Lens, circle: float | None) -> tuple[LensView, ...]:
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
        if image.lens is not None
        and any(v.cropped for v in _pinhole_views(image, image.lens, None))
    ]
    if cropped:
        logger.warning(
            "%s: the lens distortion (%s) is valid only near the centre of the photos, so %d of %d "
            "photos are cropped",
            cropped[0].path,
            cropped[0].lens.model if cropped[0].lens else "",
            len(cropped),
            len(posed),
        )


def _lens_view(
    image: PosedImage,
    view: LensView,
    header: Header,
    size: tuple[int, int, bool],
    resolution: int | None,
) -> View:
    width, height, sideways = size
    lens = view.lens
    width = max(1, round(view.width * width / lens.width))
    height = max(1, round(view.height * height / lens.height))
    width, height = _final_size(image, width, height, resolution)
    pose = image.camera.cam_from_world
    if view.rotation is not None:
        pose = torch.tensor(view.rotation, dtype=pose.dtype) @ pose
    camera = Camera(view.width, view.height, *view.params, pose).scaled(width, height)
    stored = header.width * header.height
    source = ImageSource(image.path, width, height, sideways, stored, view)
    mask = None
    if image.mask is not None:
        mask = replace(source, path=image.mask)
    elif view.partial:
        mask = replace(source, blank=True)
    name = f"{image.name}/{view.name}" if view.name else image.name
    return View(name, camera, source, mask, *_maps_of(image))


def _final_size(
    image: PosedImage, width: int, height: int, resolution: int | None
) -> tuple[int, int]:
    if resolution is None or resolution == -1:
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


def _check_mask(path: Path, size: tuple[int, int, bool]) -> None:
    """Raise `UserError` if a mask has another aspect ratio than its image; it may be smaller."""
    width, height, sideways = size
    mask = read_header(path)
    own = (mask.width, mask.height)
    if sideways and mask.sideways:
        own = (mask.height, mask.width)
    # Sides are rounded to whole pixels of the mask, or of an image that is smaller.
    if abs(own[0] * height - own[1] * width) > max(width, height, *own):
        raise UserError(
            "{path}: the mask is {own}x{own2}, but its image is {width}x{height}; use a mask of "
            "the whole image",
            path=path,
            own=own[0],
            own2=own[1],
            width=width,
            height=height,
        )


def _test_names(
    posed: list[PosedImage],
    hold_out: int | None,
    first: int,
    test_list: Path | str | Sequence[str] | None,
) -> set[str]:
    names = sorted((image.name for image in posed), key=natural_key)
    together = _taken_together(posed)
    if test_list is not None:
        return {name for one in _listed(names, test_list, together) for name in together[one]}
    if hold_out is None:
        return set()
    if hold_out < 1:
        raise SettingError("hold_out", "{hold_out} is not valid; use 2 or more", hold_out=hold_out)
    if first < 0:
        raise SettingError("first_held_out", "{first} is not valid; use 0 or more", first=first)
    if any(image.split == "test" for image in posed):
        return {image.name for image in posed if image.split == "test"}
    frames = list(dict.fromkeys(together[name] for name in names))
    chosen = frames[first::hold_out] or [frames[len(frames) // 2]]
    return {name for frame in chosen for name in frame}


def _taken_together(posed: list[PosedImage]) -> dict[str, tuple[str, ...]]:
    """For each image name, those of its frame of a rig, sorted: the views of one panorama, … They
    are held out together, as they show the same from the same place."""
    frames: dict[str | tuple[str], list[str]] = {}
    for image in posed:
        frames.setdefault(image.frame or (image.name,), []).append(image.name)
    return {name: tuple(sorted(names)) for names in frames.values() for name in names}


def _listed(
    names: list[str], test_list: Path | str | Sequence[str], together: Mapping[str, tuple[str, ...]]
) -> set[str]:
    """The image names in a test list; folder and suffix may be omitted if the rest is unique.
    ``together`` is that of `_taken_together`: what is left may also be the name of one frame."""
    if isinstance(test_list, str | Path):
        try:
            if Path(test_list).exists() and not is_file(Path(test_list)):
                raise ValueError("not a file")
            lines = Path(test_list).read_text(encoding="utf-8").splitlines()
        except (OSError, ValueError) as error:
            raise UserError(
                "{test_list}: the list of test images cannot be read ({error})",
                test_list=test_list,
                error=error,
            ) from None
    else:
        lines = list(test_list)
    known: dict[str, set[str]] = {}
    for name in names:
        file = name.rpartition("/")[2]
        for short in {name, name.rpartition(".")[0], file, file.rpartition(".")[0]}:
            known.setdefault(short, set()).add(name)
    listed = set()
    for line in filter(None, (line.strip() for line in lines)):
        matches = {line} if line in names else known.get(line, set())
        if len({together[name] for name in matches}) != 1:
            problem = (
                "is the name of several images" if matches else "is not an image of the dataset"
            )
            raise UserError(
                "the list of test images: {line} {problem}", line=quoted(line), problem=problem
            )
        listed |= matches
    return listed
