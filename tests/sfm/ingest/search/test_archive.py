"""Zip files of photos, also those that someone made in order to harm."""

import io
import random
import struct
import zipfile

import pytest

from snowsplat.sfm.ingest.search import archive
from snowsplat.sfm.ingest.search.archive import files_in, unpack
from snowsplat.sfm.ingest.search.sources import find_sources
from snowsplat.util.errors import UserError

from ...pictures import photo


def jpeg(seed=0) -> bytes:
    packed = io.BytesIO()
    photo(width=64, height=48, seed=seed).save(packed, "JPEG")
    return packed.getvalue()


def write(path, files, **changes):
    """A zip file; ``changes`` are set in the entry of its last file."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as made:
        for name, content in files.items():
            info = zipfile.ZipInfo(name)
            info.compress_type = zipfile.ZIP_DEFLATED
            if name == list(files)[-1]:
                for key, value in changes.items():
                    setattr(info, key, value)
            made.writestr(info, content)
    return path


def inside(folder) -> list[str]:
    return sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())


def test_photos_in_folders(tmp_path):
    files = {f"DCIM/{i}.jpg": jpeg(i) for i in range(3)}
    junk = {"__MACOSX/DCIM/._0.jpg": b"x", ".DS_Store": b"x", "notes.txt": b"y"}
    path = write(tmp_path / "scan 1.zip", files | junk)
    found = find_sources([path])
    assert [source.name for source in found.files] == ["DCIM/0.jpg", "DCIM/1.jpg", "DCIM/2.jpg"]
    assert found.inputs == (path,)
    assert inside(tmp_path / "scan 1") == [*files, "notes.txt"]
    assert (tmp_path / "scan 1/DCIM/2.jpg").read_bytes() == jpeg(2)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["scan 1", "scan 1.zip"]


def test_a_folder_that_is_there_already(tmp_path):
    path = write(tmp_path / "a.zip", {"1.jpg": jpeg()})
    (tmp_path / "a").mkdir()
    (tmp_path / "a/1.jpg").write_bytes(jpeg())
    assert unpack(path) == tmp_path / "a"  # the same files: unpacked before
    (tmp_path / "a/2.jpg").write_bytes(jpeg())
    assert unpack(path) == tmp_path / "a_unpacked"
    assert unpack(path) == tmp_path / "a_unpacked"
    (tmp_path / "a_unpacked/1.jpg").write_bytes(b"")
    with pytest.raises(UserError, match="a_unpacked has other files"):
        unpack(path)


def test_names_of_other_programs(tmp_path):
    path = write(tmp_path / "a.zip", {"x\\1.jpg": b"1", "X/1.JPG": b"2", "café.jpg": b"3"})
    assert inside(unpack(path)) == ["X/1_2.JPG", "café.jpg", "x/1.jpg"]


@pytest.mark.parametrize(
    "name", ["../a.jpg", "/tmp/a.jpg", "x/../../a.jpg", "..\\a.jpg", "C:/a.jpg"]
)
def test_paths_outside(tmp_path, name):
    path = write(tmp_path / "in/a.zip" if (tmp_path / "in").mkdir() is None else "", {name: b"x"})
    with pytest.raises(UserError, match=r"a.zip: has a file outside of its folder"):
        unpack(path)
    assert inside(tmp_path) == ["in/a.zip"]


def test_links_are_not_created(tmp_path):
    path = write(tmp_path / "a.zip", {"1.jpg": b"x", "l": b"/etc"}, external_attr=0o120777 << 16)
    assert inside(unpack(path)) == ["1.jpg"]


def test_nothing_inside(tmp_path):
    path = write(
        tmp_path / "a.zip", {".hidden.jpg": b"x", "l": b"/etc"}, external_attr=0o120777 << 16
    )
    with pytest.raises(UserError, match="has no files"):
        unpack(path)
    assert not (tmp_path / "a").exists()


def test_a_password(tmp_path):
    data = bytearray(write(tmp_path / "a.zip", {"1.jpg": b"x"}).read_bytes())
    at = data.find(b"PK\x01\x02")
    data[at + 8] |= 1
    (tmp_path / "a.zip").write_bytes(data)
    with pytest.raises(UserError, match="has a password; unpack it first"):
        unpack(tmp_path / "a.zip")


def test_bombs(tmp_path, monkeypatch):
    path = write(tmp_path / "a.zip", {"1.bmp": bytes(70 << 20)})
    with pytest.raises(UserError, match="would become 1 files of 0.1 GB"):
        unpack(path)
    data = bytearray(path.read_bytes())
    struct.pack_into("<I", data, data.find(b"PK\x01\x02") + 24, 1000)  # a wrong unpacked size
    path.write_bytes(data)
    with pytest.raises(UserError, match="cannot be unpacked"):
        unpack(path)
    struct.pack_into("<I", data, data.rfind(b"PK\x05\x06") + 12, 1 << 30)
    path.write_bytes(data)
    with pytest.raises(UserError, match="has too many files"):
        unpack(path)
    monkeypatch.setattr(archive, "_MOST_FILES", 2)
    with pytest.raises(UserError, match="would become 3 files"):
        unpack(write(tmp_path / "b.zip", dict.fromkeys("abc", b"")))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.zip", "b.zip"]


def test_other_archives_and_no_photos(tmp_path):
    with pytest.raises(UserError, match="a zip file without photos"):
        find_sources([write(tmp_path / "a.zip", {"a.txt": b"x"})])
    with pytest.raises(UserError, match="is a scene"):
        find_sources([write(tmp_path / "a.zip", {"meta.json": b"{}", "means_l.webp": b"x"})])
    (tmp_path / "a.rar").write_bytes(b"Rar!\x1a\x07\x01\0")
    with pytest.raises(UserError, match="is a RAR archive; unpack it first"):
        find_sources([tmp_path / "a.rar"])
    assert len(inside(tmp_path)) == 2


def test_damage(tmp_path):
    """Any change of a zip file is an error of one line, or has no effect outside of its folder."""
    good = write(tmp_path / "a.zip", {"a/1.jpg": b"1" * 40, "2.png": b"2" * 90}).read_bytes()
    generator = random.Random(0)
    lines = []
    for i in range(300):
        data = bytearray(good[: generator.randrange(len(good))] if i % 4 == 0 else good)
        for _ in range(generator.randrange(1, 6)):
            if data:
                data[generator.randrange(len(data))] = generator.randrange(256)
        folder = tmp_path / str(i)
        folder.mkdir()
        (folder / "b.zip").write_bytes(data)
        try:
            files_in(folder / "b.zip")
            unpack(folder / "b.zip")
        except UserError as error:
            lines.append(str(error))
            assert inside(folder) == ["b.zip"]
    assert len(lines) > 100
    assert not any("\n" in line for line in lines)
    assert {p.name for p in tmp_path.iterdir()} == {"a.zip", *map(str, range(300))}
