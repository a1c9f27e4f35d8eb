"""PLY: bit-identical round trips, all dialects, one-line errors for damaged files."""

import struct
from pathlib import Path

import numpy as np
import pytest
import torch

from snowsplat.formats import ply, read_gaussians, write_gaussians
from snowsplat.scene.gaussians import SH_REST_COUNTS, Gaussians
from snowsplat.util.errors import UserError

from ..gaussians import normal_gaussians

REFERENCE = Path(__file__).parents[2].parent / "shared/splats/reference_layout_sh3.ply"


def assert_same(a: Gaussians, b: Gaussians) -> None:
    for name, tensor in a.parameters().items():
        torch.testing.assert_close(b.parameters()[name], tensor, rtol=0, atol=0, equal_nan=True)


def property_names(degree: int) -> list[str]:
    rest = [f"f_rest_{i}" for i in range(3 * SH_REST_COUNTS[degree])]
    return [
        *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
        *rest,
        *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
    ]


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("n", [0, 1, 257, 20_000])
def test_round_trip_is_bit_identical(tmp_path, degree, n):
    gaussians = normal_gaussians(n, degree)
    write_gaussians(tmp_path / "scene.ply", gaussians)
    assert_same(gaussians, read_gaussians(tmp_path / "scene.ply"))
    assert [p.name for p in tmp_path.iterdir()] == ["scene.ply"]  # no temporary file remains


def test_layout_is_the_62_properties_in_order(tmp_path):
    gaussians = normal_gaussians(2, 3)
    write_gaussians(tmp_path / "scene.ply", gaussians)
    header, data = (tmp_path / "scene.ply").read_bytes().split(b"end_header\n")
    lines = header.decode().splitlines()
    assert lines[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 2"]
    assert lines[3:] == [f"property float {name}" for name in property_names(3)]
    row = dict(zip(property_names(3), struct.unpack("<62f", data[: 62 * 4]), strict=True))
    # Channel-major: f_rest_0..14 are the 15 coefficients of red.
    assert row["f_rest_1"] == gaussians.sh_rest[0, 1, 0]
    assert row["f_rest_15"] == gaussians.sh_rest[0, 0, 1]
    assert row["f_rest_44"] == gaussians.sh_rest[0, 14, 2]
    assert row["nx"] == 0.0
    assert row["opacity"] == gaussians.opacity_logits[0]
    assert row["rot_0"] == gaussians.quats[0, 0]
    assert len(data) == 2 * 62 * 4


def test_reference_file_reads_and_writes_back_the_same_bytes(tmp_path):
    if not REFERENCE.exists():
        pytest.skip(f"{REFERENCE} is missing")
    gaussians = read_gaussians(REFERENCE)
    assert len(gaussians) == 9080
    assert gaussians.sh_degree == 3
    assert all(t.isfinite().all() for t in gaussians.parameters().values())
    write_gaussians(tmp_path / "again.ply", gaussians)
    again = (tmp_path / "again.ply").read_bytes()
    assert again[:40] == REFERENCE.read_bytes()[:40]
    assert_same(gaussians, read_gaussians(tmp_path / "again.ply"))


# Dialects: the same Gaussians in other variants of PLY, by an independent writer.

TYPES = {
    "float": "f",
    "double": "d",
    "uchar": "B",
    "short": "h",
    "int": "i",
    "float32": "f",
    "uint8": "B",
}


def dialect(
    gaussians: Gaussians,
    *,
    format: str = "binary_little_endian",
    kind: str = "float",
    newline: str = "\n",
    order: int | None = None,
    extra: list[tuple[str, str, float]] = [],  # noqa: B006
    before: tuple[str, bytes] | None = None,
    after: tuple[str, bytes] | None = None,
) -> bytes:
    names = property_names(gaussians.sh_degree)
    flat = [
        gaussians.means,
        torch.zeros(len(gaussians), 3),
        gaussians.sh_dc[:, 0],
        gaussians.sh_rest.transpose(1, 2).flatten(1),
        gaussians.opacity_logits[:, None],
        gaussians.log_scales,
        gaussians.quats,
    ]
    table = torch.cat(flat, dim=1).double().tolist()
    columns = [(kind, name, [row[i] for row in table]) for i, name in enumerate(names)]
    columns += [(k, name, [value] * len(table)) for k, name, value in extra]
    if order is not None:
        np.random.default_rng(order).shuffle(columns)
    head = ["ply", f"format {format} 1.0", "comment made by a test"]
    head += before[0].split("\n") if before else []
    head += [f"element vertex {len(table)}"] + [f"property {k} {name}" for k, name, _ in columns]
    head += after[0].split("\n") if after else []
    data = before[1] if before else b""
    for row in zip(*(values for _, _, values in columns), strict=True):
        if format == "ascii":
            data += (" ".join(repr(v) for v in row) + newline).encode()
        else:
            mark = "<" if "little" in format else ">"
            codes = mark + "".join(TYPES[k] for k, _, _ in columns)
            integers = [
                int(v) if TYPES[k] in "Bhi" else v
                for (k, _, _), v in zip(columns, row, strict=True)
            ]
            data += struct.pack(codes, *integers)
    return (
        (newline.join([*head, "end_header"]) + newline).encode()
        + data
        + (after[1] if after else b"")
    )


EXTRA = [("uchar", "red", 200), ("short", "label", -3), ("double", "t", 0.5)]
CAMERA = "element camera 2\nproperty double k\nproperty uchar w"
FACES = "element face 2\nproperty list uchar int vertex_indices"
DIALECTS = {
    "plain": {},
    "big endian": {"format": "binary_big_endian"},
    "ascii": {"format": "ascii"},
    "crlf header": {"newline": "\r\n"},
    "crlf ascii": {"format": "ascii", "newline": "\r\n"},
    "doubles": {"kind": "double"},
    "float32 spelling": {"kind": "float32"},
    "shuffled": {"order": 1},
    "shuffled big-endian doubles": {"order": 2, "kind": "double", "format": "binary_big_endian"},
    "extra properties": {"extra": EXTRA, "order": 3},
    "extra, ascii": {"extra": EXTRA, "order": 4, "format": "ascii"},
    "element before": {"before": (CAMERA, b"\x01" * 18)},
    "ascii lists before": {"format": "ascii", "before": (FACES, b"3 0 1 2\n2 0 1\n")},
    "lists after": {"after": (FACES, b"\x03" + b"\x00" * 12 + b"\x01\x00\x00\x00\x00")},
}  # fmt: skip


@pytest.mark.parametrize("name", DIALECTS)
@pytest.mark.parametrize("degree", [0, 2, 3])
def test_dialects_read_the_same(tmp_path, name, degree):
    gaussians = normal_gaussians(11, degree)
    (tmp_path / "scene.ply").write_bytes(dialect(gaussians, **DIALECTS[name]))
    assert_same(gaussians, read_gaussians(tmp_path / "scene.ply"))


def test_normals_are_optional_and_nan_is_preserved(tmp_path):
    gaussians = normal_gaussians(3, 0)
    gaussians.means[1, 2] = float("nan")
    gaussians.log_scales[2, 0] = float("inf")
    data = dialect(gaussians, format="ascii").replace(
        b"property float n", b"property float other_n"
    )
    (tmp_path / "scene.ply").write_bytes(data)
    assert_same(gaussians, read_gaussians(tmp_path / "scene.ply"))


# Damage


def one_line(path: Path) -> str:
    with pytest.raises(UserError) as caught:
        read_gaussians(path)
    message = str(caught.value)
    assert "\n" not in message
    assert str(path) in message
    return message


@pytest.mark.parametrize("format", ["binary_little_endian", "binary_big_endian", "ascii"])
def test_every_truncation_is_one_line(tmp_path, format):
    data = dialect(normal_gaussians(3, 1), format=format)
    path = tmp_path / "scene.ply"
    # An ASCII file without its last line break, or without the last digits, still has all rows.
    end = len(data.rstrip().rsplit(b" ", 1)[0]) if format == "ascii" else len(data) - 1
    for length in range(0, end, 7):
        path.write_bytes(data[:length])
        one_line(path)
    path.write_bytes(data[:end])
    one_line(path)


@pytest.mark.parametrize(
    "count", ["1000000000000", "999999999999999", "9" * 30, "-1", "1e9", "²", "4"]
)
@pytest.mark.parametrize("format", ["binary_little_endian", "ascii"])
def test_counts_beyond_the_file_allocate_nothing(tmp_path, count, format):
    data = dialect(normal_gaussians(3, 0), format=format)
    path = tmp_path / "scene.ply"
    path.write_bytes(data.replace(b"element vertex 3", f"element vertex {count}".encode()))
    one_line(path)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ((b"ply\n", b"plz\n"), "not a PLY file"),
        ((b"format binary_little_endian 1.0\n", b""), "format"),
        ((b"1.0", b"2.0"), "invalid line"),
        ((b"property float opacity", b"property quaternion opacity"), "invalid line"),
        ((b"property float opacity", b"property float x"), "twice"),
        ((b"property float opacity", b"property float alpha"), "missing properties: opacity"),
        ((b"property float f_rest_8", b"property float f_rest_9"), "SH degree"),
        ((b"property float f_rest_8", b"property float other"), "SH degree"),
        ((b"property float f_rest_8", b"property list uchar float f_rest_8"), "list property"),
        ((b"element vertex", b"element vortex"), "'vertex'"),
        ((b"comment made", b"element vertex 0\ncomment made"), "2 'vertex'"),
        ((b"comment made by a test", FACES.encode()), "vertex' first"),
        ((b"end_header", b"end_heads!"), "no end"),
        ((b"comment made by a test", b"comment " + b"x" * 5000), "no end"),
    ],
)
def test_invalid_headers_are_reported(tmp_path, change, expected):
    data = dialect(normal_gaussians(3, 1))
    assert change[0] in data
    path = tmp_path / "scene.ply"
    path.write_bytes(data.replace(*change))
    assert expected in one_line(path)


def test_an_error_names_at_most_four_missing_properties(tmp_path):
    path = tmp_path / "scene.ply"
    data = dialect(normal_gaussians(3, 1)).replace(b"float rot_", b"float turn_")
    path.write_bytes(data)
    assert one_line(path).endswith("missing properties: rot_0, rot_1, rot_2, rot_3")
    path.write_bytes(data.replace(b"float opacity", b"float alpha"))
    assert one_line(path).endswith("missing properties: opacity, rot_0, rot_1, rot_2, …")


@pytest.mark.parametrize("row", [b"0.0 nonsense", b"0.0", b"", b"\xff\xfe"])
def test_ascii_rows_that_are_not_numbers(tmp_path, row):
    lines = dialect(normal_gaussians(4, 0), format="ascii").split(b"\n")
    lines[-3] = row.ljust(200)
    path = tmp_path / "scene.ply"
    path.write_bytes(b"\n".join(lines))
    one_line(path)


def test_a_missing_file_and_a_folder(tmp_path):
    assert "cannot be read" in one_line(tmp_path / "missing.ply")
    (tmp_path / "folder.ply").mkdir()
    assert "cannot be read" in one_line(tmp_path / "folder.ply")
    (tmp_path / "scene.obj").write_bytes(b"v 0 0 0")
    with pytest.raises(UserError, match=r"\.ply"):
        read_gaussians(tmp_path / "scene.obj")


def test_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "scene.ply"
    write_gaussians(path, normal_gaussians(5, 1))
    old = path.read_bytes()
    monkeypatch.setattr(ply, "_WRITE_ROWS", 0)  # makes the writer raise after the header
    with pytest.raises(ValueError, match="range"):
        write_gaussians(path, normal_gaussians(9, 1))
    assert path.read_bytes() == old
    assert [p.name for p in tmp_path.iterdir()] == ["scene.ply"]
