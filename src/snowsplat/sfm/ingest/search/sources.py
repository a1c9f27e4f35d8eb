"""Finds the input files: photos and videos, their names in ``input/``, and their masks."""

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Literal

from snowsplat.data.files.listing import files_below, folder_kind, original_of
from snowsplat.data.files.masks import FoundMasks, find_masks
from snowsplat.data.photos.image_file import OPTIONAL_FORMATS
from snowsplat.data.photos.suffixes import PHOTO_SUFFIXES, VIDEO_SUFFIXES
from snowsplat.data.readers import photo_folder, poses_in
from snowsplat.data.readers.projects import advice
from snowsplat.project.left_out import LeftOut
from snowsplat.project.project import is_output
from snowsplat.sfm.ingest.photo import folded_stem, free_name, not_used
from snowsplat.sfm.ingest.photos.photo_files import Unusable, open_image
from snowsplat.sfm.ingest.search.archive import files_in, is_zip, other_archive, unpack
from snowsplat.sfm.ingest.search.copies import find_copies
from snowsplat.sfm.ingest.search.photo_or_film import photos_or_films
from snowsplat.sfm.ingest.video.clip import ONLY_SOUND, why_no_video
from snowsplat.util.errors import UserError, cause_of
from snowsplat.util.files import shown
from snowsplat.util.messages import Message, message, plural
from snowsplat.util.names import first_names

# Formats that are not read, first raw photos: the user should learn that such photos are not used.
_UNREAD = (
    "dng cr2 cr3 crw nef nrw arw srf sr2 orf rw2 raf pef srw x3f raw iiq 3fr fff gpr rwl "
    "avif jxl jp2 j2k jpx jpf jxr psd psb exr hdr tga insp"
)
_UNREAD_SUFFIXES = frozenset(
    f".{name}" for name in _UNREAD.split() if name.upper() not in OPTIONAL_FORMATS
)
# Folders in a dataset in which programs keep models of all its images.
_MODEL_FOLDERS = ("sparse", "dense", "colmap", "opensfm")
# The name of what belongs to a photo: IMG_depth.png, r_0_depth_0001.png; depth_0001.png of
# frame_0001.jpg, thumb_01.jpg.
_KINDS = r"(?P<kind>depth|conf(?:idence)?|normal|disparity|masked|thumb(?:nail)?)s?"
_MAP = re.compile(rf"(?P<stem>.+)[._-]{_KINDS}(?:[._-]?\d+)?\.\w+", re.I)
_NUMBERED_MAP = re.compile(rf"(?:.*/)?{_KINDS}[._-]?(?P<number>\d+)\.\w+", re.I)
_NUMBERED = re.compile(r".*?(?P<number>\d+)\.\w+")
# How the photo of IMG.depth.png may end: 7-Scenes has IMG.color.png.
_COLOURS = ("", ".color", "_color", "-color", ".rgb", "_rgb")
_KINDS_OF_MAPS = {
    "depth": message("is a depth map of another photo"),
    "conf": message("is a confidence map of another photo"),
    "normal": message("is a normal map of another photo"),
    "disparity": message("is a disparity map of another photo"),
    "masked": message("is a changed copy of another photo"),
    "thumb": message("is a small copy of another photo"),
}


class NothingFoundError(UserError):
    """Neither photos nor videos, and nothing that looks like them."""


@dataclass(frozen=True)
class Source:
    """An input file."""

    path: Path
    kind: Literal["photo", "video"]
    #: Relative to ``input/``, with "/": the file of a photo, or the folder for the frames of a
    #: video ("" for ``input/`` itself).
    name: str
    mask: Path | None = None  # the mask of a photo


@dataclass(frozen=True)
class Sources:
    """The photos and videos in the inputs, as `find_sources` has found them.

    Attributes:
        inputs: the files and folders that were searched.
        files: in the order of the inputs; files of a folder are in natural order.
        left_out: the photos, videos and folders that are not used.
        unused_masks: masks without a photo.
        notes: lines for the user.
        posed: the folder with camera poses, if it is the only input.
    """

    inputs: tuple[Path, ...]
    files: list[Source]
    left_out: list[LeftOut]
    unused_masks: list[Path]
    notes: list[Message] = field(default_factory=list)
    posed: Path | None = None

    @property
    def photos(self) -> list[Source]:
        return [source for source in self.files if source.kind == "photo"]

    @property
    def videos(self) -> list[Source]:
        return [source for source in self.files if source.kind == "video"]

    @property
    def paths(self) -> list[Path]:
        """All files that structure from motion reads, including masks."""
        paths = (path for source in self.files for path in (source.path, source.mask))
        return [path for path in paths if path is not None]

    def contain(self, folder: Path) -> bool:
        """Whether ``folder`` itself is one of the inputs."""
        return any(path.resolve() == folder.resolve() for path in self.inputs)


def find_sources(inputs: Sequence[Path]) -> Sources:
    """Find photos and videos in files and folders; folders are searched recursively.

    Hidden files, datasets and output folders are skipped; so are folders of masks, depth maps and
    thumbnails. Of photos of the same picture, one is used. Of a dataset, the photos in ``input`` or
    ``images`` are used. Videos in a folder with photos are also skipped, because some phones save a
    video of three seconds with every photo. A zip file is unpacked into a folder beside it. If
    there is a single input, the files keep their names. If there are several, each input folder and
    each video gets its own folder in ``input/``, so that equal names do not collide.

    Raises:
        UserError: an input does not exist, or is neither a photo nor a video; or no file was found.
    """
    if not inputs:
        raise UserError("inputs: none given; add a folder of photos, photos or a video")
    files: list[Source] = []
    left_out: list[LeftOut] = []
    unused: list[Path] = []
    notes: list[Message] = []
    posed: Path | None = None
    seen: dict[Path, Path] = {}
    folders = {"masks"}  # names in use

    def add(source: Source) -> None:
        real = source.path.resolve()
        if real in seen:
            same = message("is the same file as {file}", file=shown(seen[real]))
            left_out.append(not_used(source.path, same))
        else:
            seen[real] = source.path
            files.append(source)

    for path in inputs:
        if not path.exists():
            raise UserError("{path}: no such file or folder", path=shown(path))
        if is_zip(path):
            path = _unpack_photos(path)
        if not path.is_dir():
            kind = kind_of_file(path)
            if kind == "photo":
                mask = find_masks(path.parent, [path.name]).of.get(path.name)
                add(Source(path, kind, shown(path.name), mask))
            else:
                add(Source(path, kind, "" if len(inputs) == 1 else free_name(path.stem, folders)))
            continue
        if (poses := poses_in(path)) is not None:
            posed = path if len(inputs) == 1 else None
            notes.append(
                message(
                    "{path}: has camera poses already ({poses}), which are estimated again; to use "
                    "them: snowsplat make {path}",
                    path=shown(path),
                    poses=shown(poses),
                )
            )
        elif (capture := photo_folder(path)) is not None:
            program, folder = capture
            notes.append(
                message(
                    "{path}: a capture of {program} without camera poses; the photos in {folder} "
                    "are used",
                    path=shown(path),
                    program=program,
                    folder=shown(folder.relative_to(path).as_posix()),
                )
            )
        elif (unread := advice(path)) is not None:
            notes.append(message("{path}: {unread}", path=shown(path), unread=unread))
        photos_in = _photos_of_dataset(path)
        found = _search(photos_in)
        photos, videos, others = photos_or_films(photos_in, found.photos, found.videos)
        prefix = "" if len(inputs) == 1 else free_name(path.resolve().name, folders)
        left_out += found.left_out + others
        for relative in photos:
            name = str(PurePosixPath(prefix) / shown(relative))
            add(Source(photos_in / relative, "photo", name, found.masks.of.get(relative)))
        unused += found.masks.unused
        for relative in videos:
            stem = str(PurePosixPath(prefix) / PurePosixPath(relative).with_suffix(""))
            video = prefix if len(videos) == 1 else free_name(stem, folders)
            add(Source(photos_in / relative, "video", video))
    if not files:
        raise _nothing_in(inputs)
    return Sources(tuple(inputs), files, left_out, unused, notes, posed)


@dataclass
class _Folder:
    """The photos and videos below a folder, relative to it."""

    photos: list[str] = field(default_factory=list)
    videos: list[str] = field(default_factory=list)
    masks: FoundMasks = field(default_factory=FoundMasks)
    left_out: list[LeftOut] = field(default_factory=list)


def _search(root: Path) -> _Folder:
    """What is in a folder: each photo once, without masks, maps, thumbnails and outputs."""
    found = _Folder()

    def enter(folder: Path, names: list[str]) -> Iterator[str]:
        for name in names:
            kind, original = folder_kind(name), original_of(name, names, divided=False)
            if is_output(folder / name) or kind == "masks":
                continue
            if kind == "maps":
                reason = message("is a folder of maps, not of photos")
            elif kind == "thumbnails":
                reason = message("is a folder of small copies")
            elif original is not None:
                reason = message(
                    "is a folder of changed copies of those in {folder}", folder=original
                )
            else:
                yield name
                continue
            found.left_out.append(not_used(folder / name, reason))

    broken: list[str] = []
    files = files_below(root, enter, broken)
    if not any(_is_photo_name(file) or _is_video_name(file) for file in files):
        found.left_out = []  # only photos called depth/1.png: they are the photos
        files = files_below(root, _masks_and_outputs)
    photos = [file for file in files if _is_photo_name(file)]
    if unread := _unread_photos(files, photos):
        found.left_out.append(not_used(root, unread))
    if links := _broken_links(broken):
        found.left_out.append(not_used(root, links))
    found.videos = [file for file in files if _is_video_name(file)]
    copies = find_copies(root, photos)
    no_views = {
        name: message("is the same picture as {photo}", photo=used) for name, used in copies.items()
    }
    no_views |= _maps_beside(root, photos)
    found.left_out += [not_used(root / name, reason) for name, reason in no_views.items()]
    photos = [photo for photo in photos if photo not in no_views]
    found.masks = find_masks(root, photos)
    found.photos = [photo for photo in photos if photo not in found.masks.beside]
    return found


def _format_name(name: str) -> str:
    """The name of a format, e.g. DNG, from the name of a file."""
    return PurePosixPath(name).suffix[1:].upper()


def _unread_photos(files: Iterable[str], read: Sequence[str]) -> Message | None:
    """What to say about the photos among ``files`` that are in such a format; None: there are none.

    Cameras save a raw photo and a JPEG of it. Therefore a photo that is also among those that are
    ``read`` does not count.
    """
    also = {folded_stem(name) for name in read}
    counts = Counter(
        _format_name(name)
        for name in files
        if PurePosixPath(name).suffix.lower() in _UNREAD_SUFFIXES and folded_stem(name) not in also
    )
    if not counts:
        return None
    if counts["INSP"]:
        return plural(
            "has {n} photo of two lenses (INSP); export an equirectangular picture of it first",
            "has {n} photos of two lenses (INSP); export equirectangular pictures of them first",
            n=counts["INSP"],
        )
    listed = " and ".join(f"{count:,} {name}" for name, count in counts.most_common())
    return plural(
        "has {listed} photo, which cannot be read; save it as JPEG or PNG first",
        "has {listed} photos, which cannot be read; save them as JPEG or PNG first",
        n=counts.total(),
        listed=listed,
    )


def _broken_links(broken: Sequence[str]) -> Message | None:
    """The reason why photos and videos are not used that are broken links; None if none is."""
    links = [name for name in broken if _is_photo_name(name) or _is_video_name(name)]
    if not links:
        return None
    return message(
        "has links to files that are missing: {links}; copy the files here",
        links=first_names(links, 1),
    )


def _masks_and_outputs(folder: Path, names: list[str]) -> list[str]:
    """The subfolders that are neither masks nor outputs."""
    return [n for n in names if folder_kind(n) != "masks" and not is_output(folder / n)]


def _is_photo_name(file: str) -> bool:
    return PurePosixPath(file).suffix.lower() in PHOTO_SUFFIXES


def _is_video_name(file: str) -> bool:
    return PurePosixPath(file).suffix.lower() in VIDEO_SUFFIXES


def _maps_beside(root: Path, photos: Sequence[str]) -> dict[str, Message]:
    """Photos that are maps or copies by their names, and what they are: IMG_depth.png beside
    IMG.jpg; depth_01.png beside frame_01.jpg, if it has one channel or half the size."""
    stems = {str(PurePosixPath(photo).with_suffix("")) for photo in photos}
    maps = {photo: m for photo in photos if (m := _NUMBERED_MAP.fullmatch(photo))}
    numbered = {photo: m for photo in photos if (m := _NUMBERED.fullmatch(photo))}
    others = {
        (PurePosixPath(photo).parent, int(match["number"])): photo
        for photo, match in numbered.items()
        if photo not in maps
    }
    found = {}
    for photo in photos:
        match = _MAP.fullmatch(photo)
        if match is None or not {match["stem"] + end for end in _COLOURS} & stems:
            match = maps.get(photo)
            key = match and (PurePosixPath(photo).parent, int(match["number"]))
            if (
                match is None
                or key not in others
                or not _is_lesser(root / photo, root / others[key])
            ):
                continue
        kind = next(kind for kind in _KINDS_OF_MAPS if match["kind"].lower().startswith(kind))
        found[photo] = _KINDS_OF_MAPS[kind]
    return found


def _is_lesser(path: Path, photo: Path) -> bool:
    """Whether an image has one channel, or is at most half as large as a photo."""
    try:
        with (
            open_image(path, header_only=True) as image,
            open_image(photo, header_only=True) as other,
        ):
            grey = len(image.getbands()) == 1 and image.mode != "P" and len(other.getbands()) > 1
            return grey or 2 * max(image.size) <= max(other.size)
    except (Unusable, OSError, ValueError):
        return False


def _photos_of_dataset(root: Path) -> Path:
    """The folder of the photos of a dataset; ``root`` itself if it is no dataset or has none."""
    if (capture := photo_folder(root)) is not None:
        return capture[1]
    poses = poses_in(root)
    # A model deeper in the folder may be that of a few of the photos.
    near = poses is not None and (len(poses.parts) == 1 or poses.parts[0] in _MODEL_FOLDERS)
    if not (near or is_output(root)):
        return root
    for name in ("input", "images"):
        if (root / name).is_dir():
            return root / name
    return root


def _unpack_photos(path: Path) -> Path:
    """The folder of a zip file of photos or videos. Raises UserError if it has none."""
    names = [PurePosixPath(name) for name in files_in(path)]
    if any(name.name in ("means_l.webp", "lod-meta.json") for name in names):
        raise UserError(
            "{path}: is a scene, and no photos; see it with: snowsplat view", path=shown(path)
        )
    if not any(name.suffix.lower() in PHOTO_SUFFIXES | VIDEO_SUFFIXES for name in names):
        raise UserError("{path}: is a zip file without photos and videos", path=shown(path))
    return unpack(path)


def kind_of_file(path: Path) -> Literal["photo", "video"]:
    """The kind of a file that was given as an input; it is determined by the content.

    Raises: UserError: neither photo nor video, or the file cannot be read.
    """
    try:
        with open(path, "rb") as file:
            head = file.read(32)
    except OSError as error:
        raise UserError(
            "{path}: cannot be read ({error})",
            path=shown(path),
            error=cause_of(error),
        ) from None
    suffix = path.suffix.lower()
    if suffix in _UNREAD_SUFFIXES:  # many are TIFF files with a small preview
        raise UserError(
            "{path}: is a {form} photo, which cannot be read; save it as JPEG or PNG first",
            path=shown(path),
            form=_format_name(path.name),
        )
    if _is_photo(head):
        return "photo"
    if archive := other_archive(path):
        raise UserError(
            "{path}: is a {archive} archive; unpack it first", path=shown(path), archive=archive
        )
    no_video = why_no_video(path)
    if no_video is None:
        return "video"
    if suffix in PHOTO_SUFFIXES:
        raise UserError(
            "{path}: not a photo, despite its extension; use another file", path=shown(path)
        )
    if suffix in VIDEO_SUFFIXES or no_video == ONLY_SOUND:
        raise UserError(
            "{path}: {no_video}; copy it again, or use another file",
            path=shown(path),
            no_video=no_video,
        )
    raise NothingFoundError(
        "{path}: neither a photo nor a video; use another file", path=shown(path)
    )


def _is_photo(head: bytes) -> bool:
    """Whether the first bytes are the signature of a photo format."""
    if head[4:8] == b"ftyp":  # HEIF shares its container with mp4
        return head[8:12] in (b"heic", b"heix", b"heim", b"heis", b"mif1", b"msf1", b"avif")
    if head[:4] == b"RIFF":
        return head[8:12] == b"WEBP"
    signatures = (b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n", b"II*\0", b"MM\0*", b"BM", b"P5", b"P6")
    return head.startswith(signatures)


def _nothing_in(inputs: Sequence[Path]) -> UserError:
    names = ", ".join(map(shown, inputs))
    for path in inputs:
        broken: list[str] = []
        files = files_below(path, _masks_and_outputs, broken)
        if reason := _unread_photos(files, []) or _broken_links(broken):
            return UserError("{names}: {reason}", names=names, reason=reason)
    return NothingFoundError(
        "{names}: no photos (JPEG, PNG, WebP, TIFF, HEIC) and no videos found; use the folder "
        "that contains them",
        names=names,
    )
