"""A table of all readers of the project: how to make a small valid file, and how to read it.

Each format is one entry in `READERS`. The tests in this folder damage the files in CI;
tests/nightly/fuzz_files.py does so for hours.
"""

import base64
import contextlib
import functools
import gzip
import io
import json
import shutil
import struct
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import av
import numpy as np
import safetensors.torch
import torch
from PIL import Image
from pillow_heif import register_heif_opener

from snowsplat.data import load_dataset
from snowsplat.data.maps.map_files import read_depth_file, read_normal_file
from snowsplat.data.maps.mask_pixels import doubt_about_files, looks_like_mask
from snowsplat.data.photos.colour_profile import to_srgb
from snowsplat.data.photos.decode import ImageSource, load_image, load_mask
from snowsplat.data.photos.decode import read_header as read_image_header
from snowsplat.data.points_ply import read_points, write_points
from snowsplat.data.readers import PROGRAMS, PhotoFolder, find_poses
from snowsplat.evaluation.lpips import Lpips
from snowsplat.formats import (
    FORMATS,
    GaussianArrays,
    format_for_reading,
    gsplat_checkpoint,
    read_gaussians,
    usd,
    write_gaussians,
)
from snowsplat.formats.lod import INDEX, LEVELS
from snowsplat.formats.lod_writer import LodSizes, write_lod
from snowsplat.formats.spz import write_spz
from snowsplat.formats.spz_container import unpack
from snowsplat.pipeline.describe import describe
from snowsplat.pipeline.run.training_files import write_beginning, write_scene
from snowsplat.project.left_out import LeftOut
from snowsplat.project.training_folder import DatasetSettings, TrainingFolder
from snowsplat.scene.camera_json import read_cameras, write_cameras
from snowsplat.scene.gaussians import Gaussians
from snowsplat.sfm import make_dataset
from snowsplat.sfm.ingest.content.sharpness import BLACK
from snowsplat.sfm.ingest.inputs import Gathered
from snowsplat.sfm.ingest.photo import Photo
from snowsplat.sfm.ingest.photos import mask_files, photo_files
from snowsplat.sfm.ingest.search import archive
from snowsplat.sfm.ingest.video import clip, video_frames
from snowsplat.sfm.progress import silent
from snowsplat.synthetic.toy_dataset import write_toy_dataset
from snowsplat.training.core import checkpoint
from snowsplat.training.core.history import History
from snowsplat.training.settings.config import TrainConfig
from snowsplat.util import limited_child
from snowsplat.util.errors import UserError
from snowsplat.util.stages import Stages

from ..data.photos import colour_profiles
from ..data.readers import exports
from ..formats.test_ksplat import ksplat, section
from ..gaussians import normal_gaussians
from ..sfm.pictures import exif, pan, photo, write_video
from ..usd import USD
from .limits import address_limit

# Memory per pixel while an image is decoded, in bytes.
_IMAGE_BYTES = 16
# Memory per pixel of a video, in bytes. Several frames are decoded at the same time.
_FRAME_BYTES = 96


@dataclass(frozen=True)
class Reader:
    """A reader, and valid files for it.

    Attributes:
        name: the id of the test.
        file: the file to damage, in the folder that ``make`` fills.
        make: writes valid files into a folder.
        read: reads that folder. The size of the result counts for the memory limit.
        json: also damage the file as JSON.
        pack: packs or compresses the damaged content. Without it, a checksum would reject most
            damage before the reader parses the content.
        extra: memory that the reader may take beyond the general limit, from the current file.
    """

    name: str
    file: str
    make: Callable[[Path], object]
    read: Callable[[Path], Any]
    json: bool = False
    pack: Callable[[bytes], bytes] | None = None
    extra: Callable[[Path], int] = lambda path: 0

    @functools.cached_property
    def folder(self) -> Path:
        """A folder with valid files, written once."""
        folder = Path(tempfile.mkdtemp(prefix="snowsplat-fuzz-", dir=_root().name))
        self.make(folder)
        return folder

    @functools.cached_property
    def valid(self) -> bytes:
        """The valid content of ``file``, not packed."""
        return (self.folder / self.file).read_bytes()

    def write(self, data: bytes) -> int:
        """Write ``data`` to ``file``, packed; return the size of the file."""
        packed = data if self.pack is None else self.pack(data)
        path = self.folder / self.file
        path.unlink()  # some file systems write the content of a truncated file to disk at once
        path.write_bytes(packed)
        return len(packed)

    def memory(self) -> int:
        """Memory beyond the general limit for the current file, in bytes."""
        return self.extra(self.folder / self.file)


@functools.cache
def _root() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="snowsplat-fuzz-")


# Exports of other programs


def _export(file: str, make: Callable[[Path], object], json: bool = False) -> Reader:
    def read(folder: Path) -> object:
        found = find_poses(folder)
        if found is None or found.reader not in PROGRAMS:
            raise UserError("no cameras of another program")
        return found.reader.read(found.files, PhotoFolder(folder))

    return Reader(f"export {file}", file, make, read, json)


# Scenes


def make_scene(n: int, degree: int) -> Gaussians:
    return normal_gaussians(n, degree, n + degree)


def _scene(file: str) -> Reader:
    return Reader(
        f"scene {file}",
        file,
        lambda folder: write_gaussians(folder / file, make_scene(30, 1)),
        _reads(file),
        extra=lambda _: limited_child._MEMORY if "usd" in file else 0,
    )


def _spz(name: str, version: int, pack: Callable[[bytes], bytes] | None = None) -> Reader:
    def make(folder: Path) -> None:
        path = folder / "a.spz"
        write_spz(path, GaussianArrays.from_gaussians(make_scene(30, 2)), max(version, 2))
        if version == 4:
            return
        columns = unpack(path.read_bytes()).columns
        if version == 1:
            columns[0] = bytes(range(30)) * 6
        head = struct.pack("<4sIIBBBB", b"NGSP", version, 30, 2, 12, 0, 0)
        path.write_bytes(head + b"".join(columns))

    read = _reads("a.spz")
    return Reader(name, "a.spz", make, read, pack=pack)


def _ascii_ply(folder: Path) -> None:
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1"]
    names += ["scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    lines = ["ply", "format ascii 1.0", "element other 2", "property int a", "element vertex 9"]
    lines += [f"property float {name}" for name in names] + ["end_header", "1", "2"]
    lines += [" ".join(f"{i + 0.1 * k:g}" for k in range(len(names))) for i in range(9)]
    (folder / "a.ply").write_text("\n".join([*lines, ""]))


def _ksplat(level: int) -> Reader:
    def make(folder: Path) -> None:
        sections = [
            section(make_scene(11, 1), level, 2, [1, 2]),
            section(make_scene(4, 0), level, 1, []),
        ]
        (folder / "a.ksplat").write_bytes(ksplat(sections, level, 15))

    return Reader(f"scene ksplat level {level}", "a.ksplat", make, _reads("a.ksplat"))


@functools.cache
def _sog_members() -> dict[str, bytes]:
    with tempfile.TemporaryDirectory() as folder:
        write_gaussians(Path(folder) / "a.sog", make_scene(30, 1))
        with zipfile.ZipFile(Path(folder) / "a.sog") as bundle:
            return {name: bundle.read(name) for name in bundle.namelist()}


def _sog_bundle(name: str, data: bytes) -> bytes:
    """A bundle with one member replaced, with valid sizes and checksums."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as bundle:
        for member, content in (_sog_members() | {name: data}).items():
            bundle.writestr(member, content)
    return packed.getvalue()


def _sog_part(member: str) -> Reader:
    return Reader(
        f"scene sog, its {member}",
        "a.sog",
        lambda folder: (folder / "a.sog").write_bytes(_sog_members()[member]),
        _reads("a.sog"),
        json=member.endswith("json"),
        pack=lambda data: _sog_bundle(member, data),
    )


def _sog_folder(folder: Path) -> None:
    for name, data in _sog_members().items():
        (folder / name).write_bytes(data)


def _make_levels(folder: Path) -> None:
    sizes = LodSizes(leaf=10, file=20, coarsest=8)
    write_lod(folder / INDEX, GaussianArrays.from_gaussians(make_scene(30, 1)), sizes=sizes)


def _glb_json(data: bytes) -> bytes:
    """A GLB file with this JSON, and with the binary data of the valid file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.glb"
        write_gaussians(path, make_scene(30, 1))
        valid = path.read_bytes()
    (size,) = struct.unpack_from("<I", valid, 12)
    rest = valid[20 + size :]
    data += b" " * (-len(data) % 4)
    head = struct.pack("<4sIIII", b"glTF", 2, 20 + len(data) + len(rest), len(data), 0x4E4F534A)
    return head + data + rest


def _make_glb_json(folder: Path) -> None:
    write_gaussians(folder / "a.glb", make_scene(30, 1))
    valid = (folder / "a.glb").read_bytes()
    (size,) = struct.unpack_from("<I", valid, 12)
    (folder / "a.glb").write_bytes(valid[20 : 20 + size])


def _gltf_files(folder: Path, name: str) -> None:
    """A glTF file in JSON, with its data in a file, and the same in a data URI."""
    write_gaussians(folder / "valid.glb", make_scene(30, 1))
    valid = (folder / "valid.glb").read_bytes()
    (size,) = struct.unpack_from("<I", valid, 12)
    document = json.loads(valid[20 : 20 + size])
    (folder / "a.bin").write_bytes(valid[28 + size :])
    inline = base64.b64encode(valid[28 + size :]).decode()
    uri = "a.bin" if name == "file.gltf" else f"data:application/octet-stream;base64,{inline}"
    document["buffers"][0]["uri"] = uri
    (folder / name).write_text(json.dumps(document))


def _variant_ply(folder: Path) -> None:
    """Two scales, colours, a 3D filter, SH of degree 4, doubles, an origin."""
    names = ["x", "y", "z", "red", "green", "blue", "opacity", "scale_0", "scale_1", "filter_3D"]
    names += [f"rot_{i}" for i in range(4)] + [f"f_rest_{i}" for i in range(72)]
    lines = ["ply", "format binary_little_endian 1.0", "comment origin 1000 2000.5 -3"]
    lines += ["element vertex 9"]
    lines += [f"property {'double' if name in 'xyz' else 'float'} {name}" for name in names]
    random = np.random.default_rng(0)
    rows = np.empty(9, [("xyz", "<f8", 3), ("others", "<f4", len(names) - 3)])
    rows["xyz"] = random.random((9, 3)) + 500_000
    rows["others"] = random.random((9, len(names) - 3))
    head = "\n".join([*lines, "end_header", ""]).encode()
    (folder / "a.ply").write_bytes(head + rows.tobytes())


def _zipped(members: dict[str, bytes], damaged: str = "") -> Callable[[bytes], bytes]:
    """Packs a zip file with one member replaced, with valid sizes and checksums."""

    def pack(data: bytes) -> bytes:
        packed = io.BytesIO()
        with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as bundle:
            for name, content in (members | {damaged: data}).items():
                bundle.writestr(name, content)
        return packed.getvalue()

    return pack


@functools.cache
def _ply() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        write_gaussians(Path(folder) / "a.ply", make_scene(9, 1))
        return (Path(folder) / "a.ply").read_bytes()


_PLACE_OF_SPLAT = {"position": [1, 2, 3], "rotation": [0, 1, 0, 0], "scale": [2, 2, 2]}
_PROJECT = json.dumps({"splats": [{**_PLACE_OF_SPLAT, "visible": True, "saturation": 1}]}).encode()


def _zip_reader(name: str, file: str, valid: Callable[[], bytes], **more: Any) -> Reader:
    return Reader(
        name, file, lambda folder: (folder / file).write_bytes(valid()), _reads(file), **more
    )


def _gsplat(folder: Path) -> None:
    parameters = zip(
        ("means", "scales", "quats", "opacities", "sh0", "shN"),
        make_scene(9, 1).parameters().values(),
        strict=True,
    )
    torch.save({"step": 7, "splats": dict(parameters)}, folder / "ckpt_7_rank0.pt")


def _make_origin(folder: Path) -> None:
    scene = make_scene(9, 0)
    scene.origin = (500_000.0, 0.5, -7.0)
    write_gaussians(folder / "a.spz", scene)


def _reads(file: str) -> Callable[[Path], Any]:
    def read(folder: Path) -> Gaussians:
        # A USD file has been read within this limit in a child process, for which no test waits.
        in_child = {"usd": usd, ".pt": gsplat_checkpoint}
        module = next((module for part, module in in_child.items() if part in file), None)
        limit = address_limit(limited_child._MEMORY) if module else contextlib.nullcontext()
        with limit, mock.patch.object(module or usd, "check_readable"):
            scene = read_gaussians(folder / file)
        if format_for_reading(folder / file).name != "PLY":  # a PLY is read unchanged
            assert bool(scene.usable_rows().all())
        return scene

    return read


# Datasets


def _dataset(format: str, file: str, **more: Any) -> Reader:
    def make(folder: Path) -> None:
        write_toy_dataset(folder, format, 5, 32, 24, n_points=20)  # type: ignore[arg-type]

    def read(folder: Path) -> Any:
        return load_dataset(folder)

    return Reader(f"dataset {format}, its {Path(file).name}", file, make, read, **more)


def _test_list(folder: Path) -> None:
    write_toy_dataset(folder, "colmap-bin", 5, 32, 24, n_points=20)
    names = sorted(path.name for path in (folder / "images").iterdir())
    (folder / "test.txt").write_text("\n".join(names[:2]))


# Images


def _image_memory(path: Path) -> int:
    try:
        header = read_image_header(path)
    except UserError:
        try:
            with photo_files.open_image(path) as image:  # also opens HEIF
                return _IMAGE_BYTES * image.width * image.height
        except Exception:
            return 0
    return _IMAGE_BYTES * header.width * header.height


_NOTES = {0x010F: "Maker", 0x0110: "Model", 0x0112: 6}
_DETAILS = {0x920A: 4.2, 0xA405: 28, 0xA002: 320, 0xA003: 240, 0xA20E: 3000.0, 0xA210: 2}
_PLACE = {1: "N", 2: (1.0, 2.0, 3.0), 3: "W", 4: (1.0, 2.0, 3.0), 5: 0, 6: 7.0}


def _save_image(path: Path, kind: str) -> None:
    register_heif_opener()
    image = photo(width=80, height=60)
    options: dict[str, Any] = {}
    if kind in ("jpg", "progressive", "webp", "heic", "tif", "png"):
        options["exif"] = exif(_NOTES, _DETAILS, _PLACE)
    if kind == "progressive":
        options["progressive"] = True
    elif kind in ("rgba", "lossless"):
        image.putalpha(128)
        options["lossless"] = True
    elif kind == "palette":
        image = image.quantize(7)
        options["transparency"] = 3
    elif kind == "deep":
        image = Image.fromarray(np.arange(80 * 60, dtype=np.uint16).reshape(60, 80) * 13)
    elif kind == "lzw":
        options["compression"] = "tiff_lzw"
    elif kind == "tif":
        options["compression"] = "tiff_adobe_deflate"
    elif kind == "rle":
        image = image.quantize(7)
    image.save(path, **options)


#: Kind of image -> suffix of its file.
IMAGES = {
    "jpg": "jpg", "progressive": "jpg", "png": "png", "rgba": "png", "palette": "png",
    "deep": "png", "webp": "webp", "lossless": "webp", "tif": "tif", "lzw": "tif", "bmp": "bmp",
    "ppm": "ppm", "avif": "avif",
}  # fmt: skip


def _png_with_checksums(data: bytes) -> bytes:
    """The bytes of a PNG with valid checksums, as far as its chunks can be parsed."""
    import zlib

    out, at = data[:8], 8
    while at + 12 <= len(data):
        (size,) = struct.unpack_from(">I", data, at)
        body = data[at + 4 : at + 8 + size]
        out += data[at : at + 4] + body + struct.pack(">I", zlib.crc32(body))
        at += 12 + size
    return out + data[at:]


def _image(kind: str, ending: str, what: str, read: Callable[[Path], Any]) -> Reader:
    file = f"a.{ending}"
    return Reader(
        f"{what} {kind}",
        file,
        lambda folder: _save_image(folder / file, kind),
        lambda folder: read(folder / file),
        pack=_png_with_checksums if ending == "png" else None,
        extra=_image_memory,
    )


def _read_image(path: Path) -> Any:
    header = read_image_header(path)
    source = ImageSource(path, header.width, header.height, header.sideways)
    return load_image(source, (1.0, 1.0, 1.0)), load_mask(source)


def _read_photo(path: Path) -> Any:
    try:
        header = photo_files.read_header(path)
        image = photo_files.decode(path, header, 4000)
        photo_files.decode_small(path, 320)
        photo_files.save(
            image, path.with_name("saved.jpg" if image.mode != "RGBA" else "s.png"), path
        )
        return image
    except photo_files.Unusable as error:
        raise UserError(str(error)) from None


#: Mode of a mask -> suffix of its file.
MASKS = {"L": "png", "1": "png", "P": "png", "RGBA": "png", "I;16": "png", "RGB": "jpg"}
MASKS |= {"F": "tif", "LA": "webp"}


def _mask(mode: str, ending: str) -> Reader:
    file = f"a.{ending}"

    def make(folder: Path) -> None:
        photo(width=80, height=60).save(folder / "photo.jpg")
        Image.effect_noise((80, 60), 90).convert(mode).save(folder / file)

    def read(folder: Path) -> Any:
        looks_like_mask(folder / file)
        doubt_about_files([folder / file])
        header = photo_files.read_header(folder / "photo.jpg")
        return mask_files.read_mask(folder / file, header, header.size(None))

    pack = _png_with_checksums if ending == "png" else None
    return Reader(f"mask {mode} {ending}", file, make, read, pack=pack, extra=_image_memory)


def _map(file: str, valid: np.ndarray) -> Reader:
    def make(folder: Path) -> None:
        if file.endswith("pfm"):
            (folder / file).write_bytes(b"Pf\n%d %d\n-1\n" % valid.shape[::-1] + valid.tobytes())
        elif file.endswith("npy"):
            np.save(folder / file, valid)
        else:
            Image.fromarray(valid).save(folder / file)

    read = read_depth_file if valid.ndim == 2 else read_normal_file
    pack = _png_with_checksums if file.endswith("png") else None
    name = f"map {file} {valid.ndim}"
    return Reader(name, file, make, lambda f: read(f / file), pack=pack, extra=_image_memory)


def _profile(mode: str, profile: Callable[[], bytes]) -> Reader:
    """A photo of this mode with a damaged ICC profile."""

    def pack(data: bytes) -> bytes:
        packed = io.BytesIO()
        Image.effect_noise((16, 12), 90).convert(mode).save(packed, "TIFF", icc_profile=data)
        return packed.getvalue()

    def read(folder: Path) -> Any:
        with Image.open(folder / "a.tif") as image:
            return np.asarray(to_srgb(image, folder / "a.tif"))

    def make(folder: Path) -> None:
        (folder / "a.tif").write_bytes(profile())

    return Reader(f"colour profile {mode}", "a.tif", make, read, pack=pack)


def _photos_in_zip(folder: Path) -> None:
    with zipfile.ZipFile(folder / "a.zip", "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr("scan/a.txt", "some text " * 9)
        for name in ("scan/1.jpg", "scan/äöü/2.jpg", "__MACOSX/._1.jpg"):
            picture = io.BytesIO()
            photo(width=16, height=12).save(picture, "JPEG")
            packed.writestr(name, picture.getvalue())


def _read_photos_in_zip(folder: Path) -> int:
    archive.files_in(folder / "a.zip")
    unpacked = archive.unpack(folder / "a.zip")
    try:
        assert {path.name for path in folder.iterdir()} == {"a.zip", unpacked.name}
        return sum(path.stat().st_size for path in unpacked.rglob("*"))
    finally:
        shutil.rmtree(unpacked)


# Videos


_FAST = Image.Quantize.FASTOCTREE  # a method to choose the colours of a palette


def _video(name: str, file: str, **options: Any) -> Reader:
    def make(folder: Path) -> None:
        # Small frames: if the header is damaged, FFmpeg searches the whole file for another format.
        pictures = [np.ascontiguousarray(picture[:120, :160]) for picture in pan(8)]
        if file.endswith("gif"):
            images = [Image.fromarray(picture).quantize(method=_FAST) for picture in pictures[:6]]
            images[0].save(folder / file, save_all=True, append_images=images[1:], duration=100)
        else:
            write_video(folder / file, pictures, **options)

    def read(folder: Path) -> Any:
        path = folder / file
        clip.why_no_video(path)
        found = clip.read_clip(path)
        return video_frames.extract_frames(found, folder, 4, 640, silent)

    def memory(path: Path) -> int:
        try:
            with clip.open_video(path) as container:
                stream = container.streams.video[0]
                return _FRAME_BYTES * stream.width * stream.height
        except (av.FFmpegError, OSError, ValueError, IndexError):
            return 0

    return Reader(f"video {name}", file, make, read, extra=memory)


# Records


def _output(folder: Path) -> TrainingFolder:
    write_toy_dataset(folder / "dataset", "colmap-bin", 5, 32, 24, n_points=20)
    dataset = load_dataset(folder / "dataset")
    out = TrainingFolder(folder / "out")
    write_beginning(out, dataset, DatasetSettings(str(folder / "dataset")), TrainConfig())
    write_scene(out, 7, make_scene(5, 0))
    figures = {"iteration": 7, "split": "test", "psnr": 20.5, "ssim": 0.9, "views": {"a": 1.0}}
    (out.path / "metrics.json").write_text(json.dumps(figures))
    history = History()
    for step in range(1, 30):
        history.step_begins()
        history.step_ends(step, 0.5 / step, 100)
    history.measure(29, 20.0, 0.9)
    history.write(out.history)
    return out


def _read_settings(folder: Path) -> Any:
    settings, background = TrainingFolder(folder / "out").settings()
    return asdict(settings), background


def _make_cfg_args(folder: Path) -> None:
    (_output(folder).path / "config.json").unlink()


def _make_checkpoint(folder: Path) -> None:
    from snowsplat.training.settings.stored import config_to_json

    tensors = {"means": torch.rand(7, 3), "order": torch.arange(5), "none": torch.zeros(0, 3)}
    meta = {
        "dataset": asdict(DatasetSettings("x")),
        "recipe": "default",
        "training": config_to_json(TrainConfig()),
        "time": {"seconds": 60.0, "spent": 3.0},
        "schedule": {"iterations": 30, "since": 0, "passed": 0.0},
    }
    checkpoint.save(folder, 5, tensors, meta)


def _read_checkpoint(folder: Path) -> Any:
    from snowsplat.pipeline.run.training_files import CheckpointMeta

    loaded = checkpoint.load(folder / "step_000005.safetensors")
    CheckpointMeta.from_checkpoint(loaded)
    return loaded


def _read_history(folder: Path) -> Any:
    history = History.read(folder / "out" / "history.json", 20)
    history.step_begins()
    history.step_ends(21, 0.1, 5)
    return history.stretches, history.measured, history.seconds


_PHOTO = Photo("a.jpg", "a.jpg", 80, 60, "g", None, 70.5, (1.0, 2.0, 3.0), False, False)


def _make_stages(folder: Path) -> None:
    stages = Stages(folder / "sfm.json", make_dataset.STAGES)
    stages.about = {"inputs": ["x"]}
    gathered = asdict(Gathered([_PHOTO], [LeftOut("b.jpg", "photos", BLACK)], []))
    stages.run("photos", {"size": None}, [folder], lambda: gathered)


def _read_stages(folder: Path) -> Any:
    stages = Stages(folder / "sfm.json", make_dataset.STAGES)
    done = stages.run(
        "photos",
        {"size": None},
        [folder],
        lambda: asdict(Gathered([_PHOTO], [], [])),
        lambda _: None,
    )
    return make_dataset._photos(folder, done.result)


def _make_lpips(folder: Path) -> None:
    # Real weights are much larger than the header, so random damage would rarely hit the header,
    # which is the only part that can break. These weights are too small to be valid.
    names = [f"features.{i}.{kind}" for i in (0, 3, 6) for kind in ("weight", "bias")]
    tensors = {name: torch.zeros(2, 3) for name in names}
    safetensors.torch.save_file(tensors, folder / "a.safetensors")


def _make_cameras(folder: Path) -> None:
    write_toy_dataset(folder / "c", "colmap-bin", 3, 32, 24, n_points=20)
    views = load_dataset(folder / "c", hold_out=None).train
    write_cameras(folder / "cameras.json", [(view.name, view.camera) for view in views])


def _make_points(folder: Path) -> None:
    random = np.random.default_rng(0)
    write_points(folder / "a.ply", random.random((40, 3)), random.integers(0, 255, (40, 3)))


# Levels have readers of their own below.
_LEFT_OUT = (LEVELS,) if USD else (LEVELS, "USD")

READERS: tuple[Reader, ...] = (
    *(
        _scene(f"a{format.suffixes[0]}")
        for format in FORMATS
        if format.read and format.write and format.name not in _LEFT_OUT
    ),
    Reader("scene a.ply, ASCII", "a.ply", _ascii_ply, _reads("a.ply")),
    *(_ksplat(level) for level in (0, 1, 2)),
    *(_spz(f"scene spz {version}", version) for version in (1, 2, 3, 4)),
    _spz("scene spz 3, in gzip", 3, gzip.compress),
    *(_sog_part(member) for member in ("meta.json", "means_l.webp", "shN_centroids.webp")),
    Reader("scene sog, a folder", "meta.json", _sog_folder, _reads("meta.json"), json=True),
    Reader("levels of detail", INDEX, _make_levels, _reads(INDEX), json=True),
    Reader("scene glb, its JSON", "a.glb", _make_glb_json, _reads("a.glb"), True, _glb_json),
    *(
        Reader(
            f"scene {name}",
            name,
            lambda folder, name=name: _gltf_files(folder, name),  # type: ignore[misc]
            _reads(name),
            json=True,
        )
        for name in ("file.gltf", "inline.gltf")
    ),
    Reader("scene a.ply of other trainers", "a.ply", _variant_ply, _reads("a.ply")),
    _zip_reader("scene in a zip file", "a.zip", lambda: _zipped({}, "a.ply")(_ply())),
    _zip_reader("scene in a zip file, its PLY", "a.zip", _ply, pack=_zipped({}, "a.ply")),
    _zip_reader(
        "scene ssproj, its document",
        "a.ssproj",
        lambda: _PROJECT,
        json=True,
        pack=lambda data: _zipped({"splat_0.ply": _ply()}, "document.json")(data),
    ),
    Reader(
        "gsplat checkpoint",
        "ckpt_7_rank0.pt",
        _gsplat,
        _reads("ckpt_7_rank0.pt"),
        extra=lambda _: limited_child._MEMORY,
    ),
    Reader("origin of a scene", "a.spz.origin.json", _make_origin, _reads("a.spz"), json=True),
    Reader("points a.ply", "a.ply", _make_points, lambda folder: read_points(folder / "a.ply")),
    *(_dataset("colmap-bin", f"sparse/0/{part}.bin") for part in ("cameras", "images", "points3D")),
    *(_dataset("colmap-txt", f"sparse/0/{part}.txt") for part in ("cameras", "images", "points3D")),
    _dataset("blender", "transforms_train.json", json=True),
    _export("cameras.xml", exports.metashape),
    _export("cameras.csv", exports.realityscan),
    _export("bundle.out", exports.bundler),
    _export("list.txt", exports.bundler),
    _export("keyframes/corrected_cameras/a.json", exports.polycam, json=True),
    _export("metadata.json", exports.record3d, json=True),
    _export("sfm_data.json", exports.openmvg, json=True),
    _export("reconstruction.json", exports.opensfm, json=True),
    _export("cameras.sfm", exports.alicevision, json=True),
    _export("poses_bounds.npy", exports.llff),
    _export("b.xmp", exports.realitycapture),
    *(
        _export(file, functools.partial(exports.matrices, layout=layout), file.endswith(".json"))
        for file, layout in {
            "pose/2.txt": "ScanNet",
            "intrinsic/intrinsic_color.txt": "ScanNet",
            "intrinsics.txt": "NSVF",
            "poses.txt": "KITTI",
            "calib.txt": "KITTI",
            "cams/00000001_cam.txt": "MVSNet",
            "cameras_sphere.npz": "IDR",
            "groundtruth.txt": "TUM",
            "traj.txt": "Replica",
            "cam_params.json": "Replica",
            "Barn.log": "Tanks and Temples",
            "frame_00001.json": "3d Scanner App",
        }.items()
    ),
    Reader(
        "list of test images",
        "test.txt",
        _test_list,
        lambda folder: load_dataset(folder, test_list=folder / "test.txt"),
    ),
    *(_image(kind, ending, "image", _read_image) for kind, ending in IMAGES.items()),
    *(_image(kind, end, "photo", _read_photo) for kind, end in (IMAGES | {"heic": "heic"}).items()),
    *(_mask(mode, ending) for mode, ending in MASKS.items()),
    *(
        _map(file, np.full((30, 40), 7, dtype))
        for file, dtype in {"a.png": "u2", "a.tif": "f4", "a.npy": "f4", "a.pfm": "f4"}.items()
    ),
    _map("a.npy", np.full((30, 40, 3), (0, 0, -1), "f4")),
    _profile("RGB", lambda: colour_profiles.colour_profile(colour_profiles.PROPHOTO, 1.8)),
    _profile("L", lambda: colour_profiles.grey_profile(1.8)),
    _profile("CMYK", lambda: colour_profiles.cmyk_profile(0.1)),
    Reader("photos in a zip file", "a.zip", _photos_in_zip, _read_photos_in_zip),
    _video("mp4", "a.mp4"),
    _video("mkv", "a.mkv"),
    _video("avi", "a.avi", codec="mjpeg"),
    _video("ts", "a.ts", codec="mpeg2video", rate=25),
    _video("gif", "a.gif"),
    Reader("checkpoint", "step_000005.safetensors", _make_checkpoint, _read_checkpoint),
    Reader(
        "cameras.json",
        "cameras.json",
        _make_cameras,
        lambda folder: read_cameras(folder / "cameras.json"),
        json=True,
    ),
    Reader("cfg_args", "out/cfg_args", _make_cfg_args, _read_settings),
    Reader("config.json", "out/config.json", _output, _read_settings, json=True),
    Reader(
        "metrics.json",
        "out/metrics.json",
        _output,
        lambda folder: describe(folder / "out"),
        json=True,
    ),
    Reader("history.json", "out/history.json", _output, _read_history, json=True),
    Reader("sfm.json", "sfm.json", _make_stages, _read_stages, json=True),
    Reader(
        "LPIPS weights",
        "a.safetensors",
        _make_lpips,
        lambda folder: Lpips.load(folder / "a.safetensors"),
    ),
)
