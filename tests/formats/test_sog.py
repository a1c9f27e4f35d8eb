"""SOG: precision of round trips; version 1; malicious files are one-line errors."""

import io
import json
import zipfile

import numpy as np
import pytest
import torch
from PIL import Image

from snowsplat.formats import read_gaussians, sog, write_gaussians
from snowsplat.formats.codebooks import palette_for
from snowsplat.formats.sog_container import Bundle
from snowsplat.scene.geometry import morton_order


def in_order(scene):
    return scene.select(morton_order(scene.means))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("n", [1, 2, 17, 2000])
def test_round_trip(tmp_path, make_scene, rotation_error, degree, n):
    scene, path = in_order(make_scene(n, degree)), tmp_path / "a.sog"
    write_gaussians(path, scene)
    read = read_gaussians(path)
    assert (len(read), read.sh_degree) == (n, degree)
    # 16 bits between the bounds, of logarithms.
    span = torch.log1p(scene.means.abs()).max() * 2
    error = (read.means - scene.means).abs() / (1 + scene.means.abs())
    assert float(error.max()) <= float(span) / 65535 * 0.51 + 1e-6
    # 256 levels, as dense as the values: the error is that of a cell.
    assert float((read.log_scales - scene.log_scales).square().mean().sqrt()) < 0.02
    assert float((read.sh_dc - scene.sh_dc).square().mean().sqrt()) < 0.02
    assert float((read.opacities - scene.opacities).abs().max()) <= 0.51 / 255
    # Half a step is 2^½ / 510; the largest entry, at least ½, is computed from the others.
    assert rotation_error(scene, read) < 0.0091
    if degree:
        rough = (read.sh_rest - scene.sh_rest).square().mean() / scene.sh_rest.square().mean()
        assert float(rough) < (1e-3 if n < 100 else 0.6)  # noise does not cluster


def test_a_palette_has_no_more_rows_than_requested():
    """Each of many small clusters has one row; the large cluster gets at most the other rows."""
    random = np.random.default_rng(0)
    rows = np.zeros((5_000, 3), np.float32)
    rows[:300] = random.normal(0, 1000, (300, 3))
    rows[300:] = random.normal(0, 1e-3, (4_700, 3))
    for count in (64, 500, 2000):
        palette, labels = palette_for(rows, count)
        assert len(palette) <= count
        assert 0 <= labels.min() <= labels.max() < len(palette)


def test_a_real_scene(tmp_path, shared, psnr):
    scene = read_gaussians(shared / "reference_layout_sh3.ply")
    write_gaussians(tmp_path / "a.sog", scene)
    read = read_gaussians(tmp_path / "a.sog")
    assert (tmp_path / "a.sog").stat().st_size < 40 * len(scene)
    assert psnr(scene, read) > 40
    explained = 1 - (read.sh_rest - in_order(scene).sh_rest).var() / scene.sh_rest.var()
    assert float(explained) > 0.99


def test_equal_scenes_are_equal_files(tmp_path, make_scene):
    scene = make_scene(3000)
    for name in ("a.sog", "b.sog"):
        write_gaussians(tmp_path / name, scene)
    assert (tmp_path / "a.sog").read_bytes() == (tmp_path / "b.sog").read_bytes()


def test_colours_of_transparent_gaussians_are_preserved(tmp_path, make_scene):
    scene = in_order(make_scene(200, 0))
    scene.opacity_logits[:] = -20.0
    write_gaussians(tmp_path / "a.sog", scene)
    read = read_gaussians(tmp_path / "a.sog")
    assert float((read.sh_dc - scene.sh_dc).abs().max()) < 0.1
    assert float(read.opacities.max()) < 1 / 510


def members(path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as bundle:
        return {name: bundle.read(name) for name in bundle.namelist()}


def bundle(path, files: dict[str, bytes], compression: int = zipfile.ZIP_STORED):
    with zipfile.ZipFile(path, "w", compression) as out:
        for name, data in files.items():
            out.writestr(name, data)
    return path


@pytest.fixture
def files(tmp_path, make_scene):
    """The members of a small bundle, with its meta.json as a dictionary under ``None``."""
    write_gaussians(tmp_path / "seed.sog", make_scene(50, 2))
    return members(tmp_path / "seed.sog")


def with_meta(files, change) -> dict[str, bytes]:
    meta = json.loads(files["meta.json"])
    change(meta)
    return files | {"meta.json": json.dumps(meta).encode()}


def test_the_layout_is_that_of_the_specification(files):
    meta = json.loads(files["meta.json"])
    assert (meta["version"], meta["count"], meta["shN"]["bands"]) == (2, 50, 2)
    for entry in ("scales", "sh0", "shN"):
        assert len(meta[entry]["codebook"]) == 256
        assert meta[entry]["codebook"] == sorted(meta[entry]["codebook"])
    named = [
        name
        for entry in meta.values()
        if isinstance(entry, dict)
        for name in entry.get("files", [])
    ]
    assert {*named, "meta.json"} == set(files)
    sizes = {
        name: Image.open(io.BytesIO(data)).size for name, data in files.items() if ".webp" in name
    }
    assert sizes.pop("shN_centroids.webp") == (64 * 8, 1)
    assert set(sizes.values()) == {(8, 8)}
    assert all(data[12:16] in (b"VP8L", b"VP8X") for name, data in files.items() if ".webp" in name)
    quats = np.asarray(Image.open(io.BytesIO(files["quats.webp"])).convert("RGBA")).reshape(-1, 4)
    assert quats[:50, 3].min() >= 252


def test_deflated_members_and_a_folder(tmp_path, files):
    expected = read_gaussians(tmp_path / "seed.sog")
    read = read_gaussians(bundle(tmp_path / "a.sog", files, zipfile.ZIP_DEFLATED))
    torch.testing.assert_close(read.means, expected.means, rtol=0, atol=0)
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)
    read = read_gaussians(tmp_path / "meta.json")
    torch.testing.assert_close(read.sh_rest, expected.sh_rest, rtol=0, atol=0)


def test_version_1(tmp_path, files):
    """The levels are evenly spaced between mins and maxs, and the palette has no count."""

    def older(meta):
        meta["means"]["shape"] = [meta.pop("count"), 3]
        del meta["version"]
        meta["scales"] |= {"mins": [-6, -5, -4], "maxs": [0, 0, 1]}
        meta["sh0"] |= {"mins": [-1, -2, -3, -4], "maxs": [1, 2, 3, 5]}
        meta["shN"] = {"mins": -0.5, "maxs": 0.25, "files": meta["shN"]["files"]}

    read = read_gaussians(bundle(tmp_path / "a.sog", with_meta(files, older)))
    expected = read_gaussians(tmp_path / "seed.sog")
    torch.testing.assert_close(read.means, expected.means, rtol=0, atol=0)
    torch.testing.assert_close(read.quats, expected.quats, rtol=0, atol=0)

    def pixels(name):
        image = Image.open(io.BytesIO(files[name])).convert("RGBA")
        return torch.from_numpy(np.array(image)).reshape(-1, 4)[:50].double() / 255

    scales = torch.tensor([-6.0, -5, -4]) + torch.tensor([6.0, 5, 5]) * pixels("scales.webp")[:, :3]
    torch.testing.assert_close(read.log_scales, scales.float())
    color = torch.tensor([-1.0, -2, -3, -4]) + torch.tensor([2.0, 4, 6, 9]) * pixels("sh0.webp")
    torch.testing.assert_close(read.sh_dc[:, 0], color[:, :3].float())
    torch.testing.assert_close(read.opacity_logits, color[:, 3].float())
    assert read.sh_degree == 2
    assert -0.5 <= float(read.sh_rest.min()) < float(read.sh_rest.max()) <= 0.25


def test_a_missing_first_level_is_restored(tmp_path, files):
    """Some files have codebooks that begin with null in place of the lowest level."""

    def lose(meta):
        meta["scales"]["codebook"][0] = None

    assert len(read_gaussians(bundle(tmp_path / "a.sog", with_meta(files, lose)))) == 50


BROKEN = {
    "no means": lambda meta: meta.pop("means"),
    "means a number": lambda meta: meta.update(means=3),
    "count a word": lambda meta: meta.update(count="many"),
    "count negative": lambda meta: meta.update(count=-1),
    "count true": lambda meta: meta.update(count=True),
    "count huge": lambda meta: meta.update(count=10**12),
    "count true size, bomb": lambda meta: meta.update(count=10**6),
    "version 9": lambda meta: meta.update(version=9),
    "one file of two": lambda meta: meta["means"].update(files=["means_l.webp"]),
    "file a number": lambda meta: meta["quats"].update(files=[7]),
    "missing file": lambda meta: meta["quats"].update(files=["other.webp"]),
    "no file": lambda meta: meta["quats"].update(files=[]),
    "path out": lambda meta: meta["quats"].update(files=["../../etc/passwd"]),
    "wrong image": lambda meta: meta["quats"].update(files=["shN_centroids.webp", ""]),
    "meta as an image": lambda meta: meta["sh0"].update(files=["meta.json"]),
    "codebook too long": lambda meta: meta["sh0"].update(codebook=[0.0] * 300),
    "codebook of words": lambda meta: meta["sh0"].update(codebook=["a"] * 256),
    "codebook of lists": lambda meta: meta["sh0"].update(codebook=[[]]),
    "mins short": lambda meta: meta["means"].update(mins=[0, 0]),
    "palette elsewhere": lambda meta: meta["shN"].update(files=["sh0.webp", "shN_labels.webp"]),
}


@pytest.mark.parametrize("name", BROKEN)
def test_an_invalid_meta_json_is_reported(tmp_path, files, one_line, name):
    if name == "wrong image":  # as large as the others, but not of quaternions
        files = files | {"shN_centroids.webp": b"RIFF0000WEBPVP8L"}
    one_line(bundle(tmp_path / "a.sog", with_meta(files, BROKEN[name])))


@pytest.mark.slow
def test_decompression_bombs(tmp_path, files, one_line):
    zeros = bytes(100 << 20)
    path = bundle(tmp_path / "a.sog", files | {"quats.webp": zeros}, zipfile.ZIP_DEFLATED)
    assert "would unpack to" in one_line(path)
    blank = io.BytesIO()
    Image.new("RGBA", (9000, 9000)).save(blank, format="WEBP", lossless=True)
    path = bundle(tmp_path / "a.sog", files | {"quats.webp": blank.getvalue()})
    assert "9000×9000 pixels" in one_line(path)
    deep = b'{"means":' + b"[" * 100_000 + b"]" * 100_000 + b"}"
    assert "not valid JSON" in one_line(bundle(tmp_path / "a.sog", files | {"meta.json": deep}))
    path = bundle(tmp_path / "a.sog", files, zipfile.ZIP_LZMA)
    assert "compression method" in one_line(path)


def test_the_number_of_members_is_limited(tmp_path, one_line):
    """A directory of the zip file of more than 1 MiB is refused before it is read."""
    names = {f"{number}{'x' * 30_000}": b"" for number in range(36)}
    assert "implausible number of members" in one_line(bundle(tmp_path / "a.sog", names))
    names = dict(list(names.items())[:30])
    assert "without a scene" in one_line(bundle(tmp_path / "a.sog", names))


def test_the_size_of_a_folder_is_that_of_its_files(tmp_path, files):
    """Each existing file counts once. The size of a zip file is the size of the file itself."""
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)
    names = [name for name in files if name != "meta.json"]
    with Bundle(tmp_path / "meta.json") as folder:
        total = sum(map(len, files.values()))
        assert folder.bytes_with([*names, names[0], "missing.webp"]) == total
        assert folder.bytes_with(names[1:]) == total - len(files[names[0]])
    path = bundle(tmp_path / "a.sog", files)
    with Bundle(path) as packed:
        assert packed.bytes_with(names) == path.stat().st_size


def test_not_a_scene(tmp_path, one_line):
    assert "contains 'x'" in one_line(bundle(tmp_path / "a.sog", {"x": b""}))
    assert "without 'meta.json'" in one_line(bundle(tmp_path / "a.sog", {"x.webp": b""}))
    (tmp_path / "b.sog").write_bytes(b"PK\x03\x04 and no more")
    assert "zip" in one_line(tmp_path / "b.sog")
    assert "meta.json" in one_line(bundle(tmp_path / "c.sog", {"meta.json": b"[]"}))


def test_too_many_gaussians_for_an_image(tmp_path, make_scene, monkeypatch):
    monkeypatch.setattr(sog, "_SIDE_LIMIT", 7)
    with pytest.raises(Exception, match="too many for SOG"):
        write_gaussians(tmp_path / "a.sog", make_scene(20, 0))
    assert not (tmp_path / "a.sog").exists()
