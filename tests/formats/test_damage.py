"""Randomly damaged files of every format: a one-line error or a valid scene, in little memory.

SNOWSPLAT_FUZZ=5000 sets the number of random examples per format; the default is 60 fixed ones.
"""

import os
import struct
import tracemalloc
import warnings

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from snowsplat.formats import FORMATS, read_gaussians, write_gaussians
from snowsplat.formats.gaussian_arrays import GaussianArrays
from snowsplat.formats.spz import write_spz
from snowsplat.formats.spz_container import Header, pack, unpack
from snowsplat.scene.gaussians import Gaussians
from snowsplat.util.errors import UserError

from ..usd import USD

EXAMPLES = int(os.environ.get("SNOWSPLAT_FUZZ", "0"))
QUIET = [HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
FUZZ = settings(
    max_examples=EXAMPLES or 60,
    derandomize=not EXAMPLES,
    deadline=None,
    suppress_health_check=QUIET,
)
READ_AND_WRITTEN = [f for f in FORMATS if f.read and f.write and (USD or f.name != "USD")]
WORDS = [0, 1, 2, 255, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 0x7F800000, 0x7FC00000]

#: Position, kind of change, and values. The position is a fraction of the file or, in half of the
#: cases, of its first 200 bytes.
changes = st.lists(
    st.tuples(
        st.booleans(),
        st.floats(0, 1),
        st.sampled_from(["byte", "word", "cut", "drop", "double"]),
        st.integers(0, 255),
        st.sampled_from(WORDS),
    ),
    min_size=1,
    max_size=4,
)


def damaged(data: bytes, changes: list[tuple[bool, float, str, int, int]]) -> bytes:
    for in_head, where, what, byte, word in changes:
        at = int(where * (min(len(data), 200) if in_head else len(data)))
        if what == "byte":
            data = data[:at] + bytes([byte]) + data[at + 1 :]
        elif what == "word":
            data = data[:at] + struct.pack("<I", word) + data[at + 4 :]
        elif what == "cut":
            data = data[:at]
        elif what == "drop":
            data = data[:at] + data[at + 1 + byte :]
        else:
            data = data[:at] + data[max(at - byte, 0) :]
    return data


@pytest.mark.slow
@pytest.mark.parametrize("format", READ_AND_WRITTEN, ids=lambda format: format.name)
@FUZZ
@given(changes=changes)
def test_any_format(tmp_path, make_scene, survives, format, changes):
    path = tmp_path / f"a{format.suffixes[0]}"
    seed = tmp_path / "seed"
    if not seed.exists():
        write_gaussians(path, make_scene(20, 1))
        seed.write_bytes(path.read_bytes())
    path.write_bytes(damaged(seed.read_bytes(), changes))
    survives(path)


@FUZZ
@given(changes=changes)
def test_spz_without_the_checksum_of_gzip(tmp_path, make_scene, survives, changes):
    path, seed = tmp_path / "a.spz", tmp_path / "seed.spz"
    if not seed.exists():
        write_spz(seed, GaussianArrays.from_gaussians(make_scene(20, 2)))
        contents = unpack(seed, seed.read_bytes())
        head = struct.pack("<4sIIBBBB", b"NGSP", 3, 20, 2, contents.header.fractional_bits, 0, 0)
        seed.write_bytes(head + b"".join(contents.columns))
    path.write_bytes(damaged(seed.read_bytes(), changes))
    survives(path)


@FUZZ
@given(changes=changes)
def test_spz_of_version_4(tmp_path, make_scene, survives, changes):
    path, seed = tmp_path / "a.spz", tmp_path / "seed.spz"
    if not seed.exists():
        write_spz(seed, GaussianArrays.from_gaussians(make_scene(20, 1)), 4)
    path.write_bytes(damaged(seed.read_bytes(), changes))
    survives(path)


@pytest.mark.parametrize("format", [f for f in FORMATS if f.read], ids=lambda format: format.name)
def test_empty_files_and_noise(tmp_path, survives, format):
    path = tmp_path / f"a{format.suffixes[0]}"
    path.parent.mkdir(exist_ok=True)
    for data in (b"", b"\0", bytes(5000), bytes(range(256)) * 20):
        path.write_bytes(data)
        survives(path)


@pytest.mark.parametrize("format", READ_AND_WRITTEN, ids=lambda format: format.name)
def test_unusable_gaussians_are_left_out_with_a_warning(tmp_path, make_scene, caplog, format):
    if format.name == "PLY":
        pytest.skip("PLY stores non-finite values")
    scene = make_scene(20, 1)
    scene.means[3, 1] = torch.nan
    scene.log_scales[4, 0] = torch.inf
    scene.quats[5, 2] = torch.nan
    scene.opacity_logits[6] = torch.nan
    scene.sh_rest[7, 1, 1] = torch.inf
    path = tmp_path / f"a{format.suffixes[0]}"
    write_gaussians(path, scene)
    reasons = "positions of 1, scales of 1, rotations of 1, opacities of 1, colours of 1"
    assert f"5 of 20 Gaussians are not finite ({reasons}); left out" in caplog.text
    read = read_gaussians(path)
    assert len(read) == 15
    assert bool(read.usable_rows().all())


@pytest.mark.parametrize("format", READ_AND_WRITTEN, ids=lambda format: format.name)
def test_extreme_but_finite_scenes_are_written_and_read(tmp_path, make_scene, format):
    scene = make_scene(40, 3)
    for i, value in enumerate((1e38, -1e38, 1e20, 0.0, 1e-30)):
        for tensor in scene.parameters().values():
            tensor[i] = value
    path = tmp_path / f"a{format.suffixes[0]}"
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # of NumPy
        write_gaussians(path, scene)
    assert 35 <= len(read_gaussians(path)) <= 40


def test_a_decompression_bomb_takes_no_memory(tmp_path):
    """The file is refused before memory is allocated for its declared size."""
    path = tmp_path / "a.spz"
    path.write_bytes(pack(Header(4, 30_000_000, 0, 12, 0), [bytes(9 * 30_000_000)]))
    assert path.stat().st_size < 100_000
    tracemalloc.start()
    try:
        with pytest.raises(UserError, match="malicious"):
            read_gaussians(path)
        assert tracemalloc.get_traced_memory()[1] < 5_000_000
    finally:
        tracemalloc.stop()


def test_a_scene_without_gaussians_is_written_and_read(tmp_path):
    for format in READ_AND_WRITTEN:
        path = tmp_path / f"a{format.suffixes[0]}"
        shapes = ((0, 3), (0, 3), (0, 4), (0,), (0, 1, 3), (0, 15, 3))
        write_gaussians(path, Gaussians(*(torch.zeros(shape) for shape in shapes)))
        assert len(read_gaussians(path)) == 0
