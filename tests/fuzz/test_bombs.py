"""Malicious files, one for each known attack: rejected quickly, with one line and little memory.

Each of these attacks once worked. If a reader ignores an attack instead of rejecting the file, the
test checks the result.
"""

import io
import json
import logging
import os
import shutil
import struct
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors import safe_open
from safetensors.torch import save_file

from snowsplat.data import load_dataset
from snowsplat.data.photos.decode import ImageSource, load_image, read_header
from snowsplat.evaluation.lpips import Lpips
from snowsplat.formats import read_gaussians, write_gaussians
from snowsplat.project.training_folder import TrainingFolder
from snowsplat.scene.camera_json import read_cameras
from snowsplat.sfm import make_dataset
from snowsplat.sfm.colmap.result import describe_model
from snowsplat.sfm.ingest.photos import photo_files
from snowsplat.sfm.ingest.video.clip import read_clip, why_no_video
from snowsplat.synthetic.toy_dataset import write_toy_dataset
from snowsplat.training.core import checkpoint
from snowsplat.training.core.history import History
from snowsplat.util import limited_child
from snowsplat.util.errors import UserError
from snowsplat.util.stages import Stages

from ..sfm.conftest import make_model
from ..sfm.pictures import pan, write_video
from .limits import guarded
from .readers import make_scene


@pytest.fixture
def rejected(tmp_path):
    """A function that reads ``tmp_path`` with `guarded` and returns the reader's error message."""

    def rejected(read) -> str:
        size = sum(path.stat().st_size for path in tmp_path.rglob("*") if path.is_file())
        result = guarded(read, tmp_path, size)
        assert isinstance(result, UserError), result
        return str(result)

    return rejected


def decoded(path: Path):
    return load_image(ImageSource(path, 64, 64))


# Images


def packed_zeros(count: int) -> bytes:
    """``count`` zeros in the format of zlib, from repetitions of one compressed block."""
    packer = zlib.compressobj(9, wbits=-15)
    block = packer.compress(bytes(1 << 20)) + packer.flush(zlib.Z_FULL_FLUSH)
    last = zlib.compressobj(9, wbits=-15)
    end = last.compress(bytes(count % (1 << 20))) + last.flush()
    checksum = struct.pack(">HH", count % 65521, 1)
    return b"\x78\xda" + block * (count >> 20) + end + checksum


def png(width: int, height: int) -> bytes:
    """A black image whose file has about a thousandth of a byte per pixel."""
    rows = packed_zeros((1 + 3 * width) * height)
    chunks = [(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)), (b"IDAT", rows)]
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        for kind, body in [*chunks, (b"IEND", b"")]
    )


def bmp_that_skips(width: int) -> bytes:
    """A run-length encoded image that skips 255 rows at a time."""
    head = struct.pack("<IiiHHIIiiII", 40, width, 1, 1, 8, 1, 0, 0, 0, 256, 0) + bytes(1024)
    return (
        b"BM" + struct.pack("<IHHI", 0, 0, 0, 14 + len(head)) + head + b"\0\2\0\xff" * 4 + b"\0\1"
    )


def tiff(entries: list[tuple[int, int, int, int]], data: bytes) -> bytes:
    body = b"".join(struct.pack("<HHII", *entry) for entry in entries)
    return b"II*\0\x08\0\0\0" + struct.pack("<H", len(entries)) + body + bytes(4) + data


def jpeg_of_scans(side: int, scans: int, between: bytes = b"") -> bytes:
    """A progressive JPEG that repeats its last scan. Each scan has few bytes but all pixels."""
    packed = io.BytesIO()
    Image.new("RGB", (side, side), (90, 99, 128)).save(packed, "JPEG", progressive=True, quality=50)
    data = packed.getvalue()
    last = data.rfind(b"\xff\xda")
    return data[:-2] + between + data[last:-2] * scans + b"\xff\xd9"


@pytest.mark.parametrize(
    ("name", "data", "line"),
    [
        ("wide.png", lambda: png(66_000, 2), "more than 178 million pixels, or 65,535 a side"),
        ("large.png", lambda: png(13_500, 13_500), "more than 178 million pixels"),
        ("skips.bmp", lambda: bmp_that_skips(60_000), "slow to read"),
        ("long.bmp", lambda: bmp_that_skips(90_000_000), "65,535 a side"),
        ("slow.ppm", lambda: b"P6 2000 2000 254\n" + bytes(12_000_000), "slow to read"),
        ("text.ppm", lambda: b"P3 2000 2000 255\n" + b"0 " * 12_000_000, "slow to read"),
        ("scans.jpg", lambda: jpeg_of_scans(4000, 2000), "too many scans"),
        # A marker without a length. A parser that expects a length misses the next marker.
        ("tem.jpg", lambda: jpeg_of_scans(4000, 2000, b"\xff\x01"), "too many scans"),
    ],
)
@pytest.mark.filterwarnings("ignore")
def test_images(tmp_path, rejected, name, data, line):
    path = tmp_path / name
    path.write_bytes(data())
    assert line in rejected(lambda: decoded(path))


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("ending", ["jpg", "tif"])
def test_exif_tags_that_share_their_data(tmp_path, ending):
    """Thousands of tags refer to the same large block of data. (Pillow itself handles this.)"""
    path = tmp_path / f"a.{ending}"
    if ending == "jpg":
        tags = [(0x9000 + i, 7, 60_000, 0) for i in range(5000)]
        Image.new("RGB", (64, 64)).save(path, exif=b"Exif\0\0" + tiff(tags, bytes(4000)))
    else:
        sizes = [(256, 4, 1, 64), (257, 4, 1, 64), (258, 3, 1, 8), (259, 3, 1, 1), (262, 3, 1, 1)]
        sizes += [(273, 4, 1, 8), (278, 4, 1, 64), (279, 4, 1, 4096)]
        tags = [(500 + i, 7, 700_000, 0) for i in range(20_000)]
        path.write_bytes(tiff(sizes + tags, b""))
    guarded(lambda: (decoded(path), photo_files.read_header(path)), tmp_path, path.stat().st_size)


@pytest.mark.filterwarnings("ignore")
def test_memory_of_a_large_uniform_image_is_limited_by_its_pixels(tmp_path):
    """16 bytes per pixel, independent of the size of the file."""
    path = tmp_path / "a.png"
    path.write_bytes(png(6000, 6000))
    assert path.stat().st_size < 150_000
    assert read_header(path).width == 6000
    planes = guarded(lambda: decoded(path), tmp_path, path.stat().st_size, 16 * 6000 * 6000)
    assert planes.shape == (3, 64, 64)


def test_scans_are_not_counted_in_a_video_after_a_photo(tmp_path):
    """Phones append videos to photos. A video may contain the bytes of a scan marker by chance."""
    path = tmp_path / "a.jpg"
    Image.new("RGB", (4000, 3000)).save(path)
    path.write_bytes(path.read_bytes() + b"\xff\xda\0\x08" * 1000)
    assert decoded(path).shape == (3, 64, 64)


# Scenes


@pytest.fixture
def members(tmp_path) -> dict[str, bytes]:
    write_gaussians(tmp_path / "a.sog", make_scene(30, 1))
    with zipfile.ZipFile(tmp_path / "a.sog") as bundle:
        return {name: bundle.read(name) for name in bundle.namelist()}


def bundle(path: Path, members: dict[str, bytes]) -> bytearray:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed:
        for name, data in members.items():
            packed.writestr(name, data)
    return bytearray(path.read_bytes())


def test_sog_whose_member_is_larger_than_declared(tmp_path, rejected, members):
    path, size = tmp_path / "a.sog", len(members["meta.json"])
    data = bundle(path, {**members, "meta.json": members["meta.json"] + b" " * (100 << 20)})
    for signature, offset in ((b"PK\3\4", 22), (b"PK\1\2", 24)):
        struct.pack_into("<I", data, data.find(signature) + offset, size)
    path.write_bytes(data)
    assert "'meta.json' is damaged" in rejected(lambda: read_gaussians(path))


def test_sog_whose_member_has_a_huge_offset(tmp_path, rejected, members):
    path = tmp_path / "a.sog"
    data = bundle(path, {"meta.json": members["meta.json"]})
    entry, end = data.find(b"PK\1\2"), data.find(b"PK\5\6")
    place = struct.pack("<HHQ", 1, 8, 2**64 - 1)  # a 64-bit offset in the extra field
    struct.pack_into("<H", data, entry + 30, len(place))
    struct.pack_into("<I", data, entry + 42, 0xFFFFFFFF)
    struct.pack_into("<I", data, end + 12, end - entry + len(place))
    path.write_bytes(data[:end] + place + data[end:])
    assert "'meta.json' is damaged" in rejected(lambda: read_gaussians(path))


@pytest.mark.parametrize(
    "text", ["[" * 100_000, '{"means": 1, "quats": [' + "[]," * 4_000_000 + "1]}"]
)
def test_sog_with_deep_or_huge_json(tmp_path, rejected, members, text):
    path = tmp_path / "a.sog"
    bundle(path, {**members, "meta.json": text.encode()})
    rejected(lambda: read_gaussians(path))
    (tmp_path / "meta.json").write_text('{"means": 1, "quats": [' + text)
    rejected(lambda: read_gaussians(tmp_path / "meta.json"))


@pytest.mark.parametrize("name", ["../secret.webp", "/etc/hostname", "..", "", "a\0b", "pipe.webp"])
def test_sog_folder_with_paths_outside(tmp_path, rejected, members, name):
    home = tmp_path / "home"
    home.mkdir()
    for member, data in members.items():
        (home / member).write_bytes(data)
    (tmp_path / "secret.webp").write_bytes(members["means_l.webp"])
    os.mkfifo(home / "pipe.webp")
    meta = json.loads(members["meta.json"])
    meta["means"]["files"][0] = name
    (home / "meta.json").write_text(json.dumps(meta))
    rejected(lambda: read_gaussians(home / "meta.json"))


def test_sog_folder_of_many_gaussians(tmp_path):
    """The number of Gaussians is limited by the image files, not by the small meta.json."""
    write_gaussians(tmp_path / "a.sog", make_scene(70_000, 0))
    with zipfile.ZipFile(tmp_path / "a.sog") as packed:
        packed.extractall(tmp_path)
    assert len(read_gaussians(tmp_path / "meta.json")) == 70_000


@pytest.mark.parametrize(
    "text",
    [
        '{"scenes": [{"nodes": [' + "0," * 3_000_000 + '0]}], "nodes": [{}]}',
        '{"nodes": [' + "{}," * 1_000_000 + "{}]}",
        '{"meshes": [{"primitives": []}], "nodes": [{}'
        + ',{"mesh":0,"rotation":[0,0,0,1]}' * 80_000
        + "]}",
    ],
)
def test_glb_with_too_many_nodes(tmp_path, rejected, text):
    path, data = tmp_path / "a.glb", text.encode()
    data += b" " * (-len(data) % 4)
    head = struct.pack("<4sIIII", b"glTF", 2, 20 + len(data), len(data), 0x4E4F534A)
    path.write_bytes(head + data)
    rejected(lambda: read_gaussians(path))


@pytest.mark.parametrize("name", ["a.ply", "a.spz", "a.glb", "a.sog", "a.splat"])
def test_pipes_are_not_read_as_scenes(tmp_path, rejected, name):
    os.mkfifo(tmp_path / name)
    assert "pipe" in rejected(lambda: read_gaussians(tmp_path / name))


def test_ply_with_a_huge_line(tmp_path, rejected):
    path = tmp_path / "a.ply"
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1"]
    names += ["scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    head = ["ply", "format ascii 1.0", "element vertex 1"]
    head += [f"property float {name}" for name in names] + ["end_header", ""]
    path.write_text("\n".join(head) + "1 " * 20_000_000)
    assert "too long" in rejected(lambda: read_gaussians(path))


# Datasets


@pytest.fixture
def dataset(tmp_path):
    """A function that writes a dataset to ``home``, and an image outside of it."""

    def make(format: str) -> Path:
        home = tmp_path / "home"
        write_toy_dataset(home, format, 5, 32, 24, n_points=20)
        (tmp_path / "secret.png").write_bytes(next(home.rglob("*.png")).read_bytes())
        return home

    return make


def outside(tmp_path: Path) -> list[str]:
    secret = tmp_path / "secret.png"
    return ["../secret.png", str(secret), "images/../../secret.png", f"./{secret}"]


@pytest.mark.parametrize("number", range(3))
@pytest.mark.parametrize("format", ["colmap-bin", "colmap-txt"])
def test_colmap_with_an_image_outside(tmp_path, rejected, dataset, format, number):
    home = dataset(format)
    name = ["../../secret.png", str(tmp_path / "secret.png"), "a/../../../secret.png"][number]
    model = home / "sparse/0" / f"images.{format[-3:]}"
    model.write_bytes(model.read_bytes().replace(b"view_02.png", name.encode()))
    shutil.copyfile(home / "images" / "view_01.png", tmp_path / "secret.png")
    dataset = load_dataset(home, hold_out=None)  # the other photos
    assert len(dataset.train) == 4
    assert all(view.image.path.is_relative_to(home / "images") for view in dataset.train)


@pytest.mark.parametrize("number", range(4))
@pytest.mark.parametrize("key", ["file_path", "mask_path"])
def test_transforms_with_a_file_outside(tmp_path, dataset, key, number):
    home = dataset("blender")
    path = home / "transforms_train.json"
    scene = json.loads(path.read_text())
    scene["frames"][1][key] = outside(tmp_path)[number]
    path.write_text(json.dumps(scene))
    (tmp_path / "secret.png").write_bytes((home / "train" / "r_1.png").read_bytes())
    views = load_dataset(home, hold_out=None).train  # the other photos
    used = [view.image.path for view in views] + [view.mask.path for view in views if view.mask]
    assert all(file.is_relative_to(home) and file.name != "secret.png" for file in used)


def test_colmap_text_with_a_huge_line(tmp_path, rejected, dataset):
    home = dataset("colmap-txt")
    images = home / "sparse/0/images.txt"
    images.write_text("1 1 0 0 0 0 0 0 1 a.png\n" + "1 " * 10_000_000 + "\n")
    assert "should hold its observations" in rejected(lambda: load_dataset(home))
    cameras = home / "sparse/0/cameras.txt"
    cameras.write_text("1 PINHOLE " + "1 " * 10_000_000)
    assert "damaged" in rejected(lambda: load_dataset(home))
    write_toy_dataset(home, "colmap-txt", 5, 32, 24, n_points=20)
    cameras.write_text(cameras.read_text().replace("PINHOLE", "x" * 100_000))
    assert "unknown camera model" in rejected(lambda: load_dataset(home))


def test_colmap_text_with_many_points_takes_little_memory(tmp_path, dataset):
    home = dataset("colmap-txt")
    points = home / "sparse/0/points3D.txt"
    points.write_text("".join(f"1 {i % 41 + 10} 1 0 9 9 9 0\n" for i in range(750_000)))
    found = guarded(lambda: load_dataset(home), tmp_path, points.stat().st_size)
    assert len(found.points) == 750_000


def test_a_list_of_test_images_that_is_a_pipe(tmp_path, rejected, dataset):
    home = dataset("colmap-bin")
    os.mkfifo(home / "test.txt")
    assert "not a file" in rejected(lambda: load_dataset(home, test_list=home / "test.txt"))


# Photos and videos


def write_model_of(folder: Path, names: list[str]) -> None:
    """Write a model of photos with these names to ``folder``; the photos do not exist."""
    generator = torch.Generator().manual_seed(0)
    poses = torch.eye(4)[:3].repeat(len(names), 1, 1)
    poses[:, 0, 3] = torch.arange(len(names)) * 0.3
    poses[:, 2, 3] = 4
    model = make_model(poses, torch.randn(30, 3, generator=generator), names=names)
    (folder / "distorted/sparse/0").mkdir(parents=True)
    model.write(folder / "distorted/sparse/0")


@pytest.mark.parametrize("name", ["../../x.png", "/tmp/x.png"])
def test_a_model_with_photos_outside(tmp_path, name):
    """The undistorted images would be written outside too."""
    write_model_of(tmp_path, ["a.png", name])
    with pytest.raises(UserError, match="has a photo .* outside of .*input"):
        describe_model(tmp_path, [])


def test_a_model_for_which_colmap_would_allocate_all_memory(tmp_path, monkeypatch):
    monkeypatch.setattr(limited_child, "_MEMORY", 1 << 28)  # COLMAP fills it before it fails
    write_model_of(tmp_path, ["a.png", "b.png"])
    points = tmp_path / "distorted/sparse/0/points3D.bin"
    data = bytearray(points.read_bytes())
    struct.pack_into("<Q", data, 8 + 8 + 24 + 3 + 8, 1 << 34)  # the length of the first track
    points.write_bytes(data)
    with pytest.raises(UserError, match="is damaged or not supported"):
        describe_model(tmp_path, [])


@pytest.mark.parametrize(
    "text",
    [
        "ffconcat version 1.0\nfile secret.mp4\n",
        "#EXTM3U\n#EXT-X-TARGETDURATION:5\n#EXTINF:5,\nsecret.mp4\n#EXT-X-ENDLIST\n",
        "v=0\nc=IN IP4 127.0.0.1\nm=video 5004 RTP/AVP 96\na=rtpmap:96 H264/90000\n",
    ],
)
def test_a_video_that_is_a_playlist(tmp_path, text):
    write_video(tmp_path / "secret.mp4", pan(4))
    (tmp_path / "a.mp4").write_text(text)
    assert why_no_video(tmp_path / "secret.mp4") is None
    assert why_no_video(tmp_path / "a.mp4") is not None
    with pytest.raises(UserError, match="can be decoded"):
        read_clip(tmp_path / "a.mp4")


def test_a_video_whose_name_looks_like_a_url(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_video(tmp_path / "secret.mp4", pan(4))
    (tmp_path / "concat:secret.mp4").write_text("nothing")
    assert why_no_video(Path("concat:secret.mp4")) is not None


def test_a_video_with_huge_frames(tmp_path, rejected):
    path = tmp_path / "a.gif"
    frames = [Image.new("P", (9000, 9000), i) for i in range(2)]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=100)
    assert path.stat().st_size < 1_000_000
    assert "more than 67 million pixels" in rejected(lambda: read_clip(path))
    data = write_video(path.with_suffix(".avi"), pan(4), codec="mjpeg").read_bytes()
    data = data.replace(struct.pack("<ii", 320, 240), struct.pack("<ii", 9000, 9000))
    data = data.replace(struct.pack(">HH", 240, 320), struct.pack(">HH", 9000, 9000))
    path.with_suffix(".avi").write_bytes(data)
    assert "more than 67 million pixels" in rejected(lambda: read_clip(path.with_suffix(".avi")))


@pytest.mark.parametrize("count", [3_000_000, 4_000_000_000])
def test_a_video_with_too_many_frames(tmp_path, rejected, count):
    """All frames have the same size, so the file does not list their sizes."""
    path = write_video(tmp_path / "a.mp4", pan(4))
    assert why_no_video(path) is None
    data = bytearray(path.read_bytes())
    struct.pack_into(">II", data, data.find(b"stsz") + 8, 1, count)
    struct.pack_into(">I", data, data.find(b"stsc") + 16, count)  # all frames in one chunk
    path.write_bytes(data)
    assert "declares more frames" in rejected(lambda: read_clip(path))
    assert guarded(lambda: why_no_video(path), tmp_path, path.stat().st_size)


# Records


DEEP = "[" * 100_000
MANY = "[" + "[]," * 4_000_000 + "0]"


@pytest.mark.parametrize(
    "text", [DEEP, '{"a": ' + DEEP, MANY, '{"stages": ' + MANY + "}", "-" * 99]
)
def test_json_files(tmp_path, rejected, text):
    out, path = tmp_path / "out", tmp_path / "a.json"
    out.mkdir()
    path.write_text(text)
    (out / "config.json").write_text(text)
    rejected(lambda: read_cameras(path))
    rejected(lambda: Stages(path, make_dataset.STAGES))
    rejected(lambda: load_dataset(path))
    rejected(lambda: TrainingFolder(out).settings())
    empty = guarded(lambda: History.read(path, 9), tmp_path, path.stat().st_size)
    assert empty.stretches == []


@pytest.mark.parametrize(
    "text",
    [
        "-" * 200_000 + "1",
        "(" * 200_000,
        "Namespace(a=" + "-" * 200_000 + "1)",
        "Namespace(a=" + "1+" * 200_000 + "1)",
        "Namespace(a=" + "[" * 200_000,
        "Namespace(" + "a." * 200_000 + "b=1)",
        "Namespace(a='" + "\\'" * 200_000,
        "Namespace(" + " " * 1_000_000,
        "__import__('os').system('touch ran')",
        "Namespace(source_path=__import__('os').system('touch ran'))",
    ],
)
def test_cfg_args_with_code(tmp_path, rejected, monkeypatch, text):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cfg_args").write_text(text)
    assert "does not name the dataset" in rejected(lambda: TrainingFolder(tmp_path).settings())
    assert not (tmp_path / "ran").exists()


def test_weights_in_a_pickle(tmp_path, rejected):
    class Large:
        def __reduce__(self):
            return bytearray, (1 << 30,)  # torch.load(weights_only=True) executes this

    torch.save({"x": Large()}, tmp_path / "a.pth")
    assert "not a safetensors file" in rejected(lambda: Lpips.load(tmp_path / "a.pth"))


def test_a_checkpoint_whose_header_was_changed(tmp_path, rejected):
    """The numbers are complete, but their shape, dtype or metadata has changed."""
    tensors = {"a": torch.arange(12.0).reshape(4, 3), "b": torch.ones(3)}
    path = checkpoint.save(tmp_path, 5, tensors, {"rate": 0.125})
    content = path.read_bytes()
    for old, new in ((b"[4,3]", b"[3,4]"), (b'"F32"', b'"I32"'), (b"0.125", b"0.225")):
        assert content.count(old) >= 1, old
        path.write_bytes(content.replace(old, new))
        assert "damaged" in rejected(lambda: checkpoint.load(path))
    path.write_bytes(content)
    assert checkpoint.load(path).meta == {"rate": 0.125}


@pytest.mark.parametrize("dtype", [torch.float8_e4m3fn, torch.bfloat16])
def test_a_checkpoint_with_a_dtype_that_numpy_lacks(tmp_path, rejected, dtype):
    path = checkpoint.save(tmp_path, 5, {"a": torch.ones(4)}, {})
    with safe_open(path, framework="np") as file:
        metadata = file.metadata()
    save_file({"a": torch.ones(4).to(dtype)}, path, metadata)
    assert "not a checkpoint" in rejected(lambda: checkpoint.load(path))


def test_a_checkpoint_whose_meta_is_a_list(tmp_path, rejected, monkeypatch):
    """Python can convert this list to a dict."""
    monkeypatch.setattr(checkpoint, "dict", lambda given: given, raising=False)
    path = checkpoint.save(tmp_path, 5, {"a": torch.ones(4)}, [[1, 2]])
    monkeypatch.undo()
    assert "not a checkpoint" in rejected(lambda: checkpoint.load(path))


def test_safetensors_with_too_many_tensors(tmp_path, rejected):
    """Each tensor takes a thousand bytes of memory but only fifty bytes of the file."""
    empty = {"dtype": "U8", "shape": [0], "data_offsets": [0, 0]}
    head = json.dumps({f"{i:x}": empty for i in range(200_000)} | {"__metadata__": {}}).encode()
    path = tmp_path / "step_000005.safetensors"
    path.write_bytes(struct.pack("<Q", len(head)) + head)
    assert "not a checkpoint" in rejected(lambda: checkpoint.load(path))
    assert "not a safetensors file" in rejected(lambda: Lpips.load(path))


def test_weights_with_a_huge_layer_number(tmp_path, rejected):
    path = tmp_path / "a.safetensors"
    save_file({f"features.{'1' * 5000}.weight": torch.zeros(1)}, path)
    assert "is missing" in rejected(lambda: Lpips.load(path))


def test_history_with_invalid_values(tmp_path):
    stretch = {"step": 1, "steps": 1, "loss": 0.5, "seconds": 0.1, "gaussians": 5}
    wrong = ({"loss": "a"}, {"seconds": None}, {"steps": 0}, {"step": True}, {"more": 1})
    absurd = ({"gaussians": 10**400}, {"loss": 1e308}, {"seconds": -1e308})
    for changed in (*wrong, *absurd):
        content = {"stretches": [stretch | changed], "measured": [], "stride": 1}
        (tmp_path / "history.json").write_text(json.dumps(content))
        assert History.read(tmp_path / "history.json", 9).stretches == []


def test_a_record_of_stages_that_was_edited(tmp_path, caplog):
    """A stage whose recorded result was changed is repeated."""
    path, done = tmp_path / "sfm.json", []

    def run() -> dict:
        stages = Stages(path, ["one"])
        return stages.run("one", {}, [], lambda: done.append(1) or {"x": float("nan")}).result

    assert run() == run() == {"x": None}
    assert len(done) == 1
    path.write_text(path.read_text().replace('"x": null', '"x": 7'))
    assert run() == {"x": None}
    assert len(done) == 2
    path.write_text(path.read_text().replace('"seconds"', '"hours"'))
    with pytest.raises(UserError, match="delete it to start from the beginning"):
        run()


def test_log_messages_are_short_for_huge_image_names(tmp_path, caplog, dataset):
    """Warnings and errors contain image names, but only their beginning."""
    home = dataset("colmap-txt")
    images = home / "sparse/0/images.txt"
    images.write_text(images.read_text() + "9 1 0 0 0 0 0 0 1 " + "x" * 100_000 + "\n\n")
    with caplog.at_level(logging.WARNING):
        assert len(load_dataset(home, hold_out=None).train) == 5
    assert max(len(record.getMessage()) for record in caplog.records) < 1000
    assert np.isfinite(load_dataset(home).extent)
