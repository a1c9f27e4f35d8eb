"""`convert` and its edits from Python."""

import pytest
import torch

from snowsplat.formats import read_gaussians, write_gaussians
from snowsplat.formats.spz import spz_version
from snowsplat.pipeline.convert import Edits, convert
from snowsplat.pipeline.decimate import file_size, gaussians_to_keep
from snowsplat.scene.gaussians import Gaussians
from snowsplat.util.errors import SettingError, UserError


def test_number_of_gaussians_to_keep():
    assert [gaussians_to_keep(text, 400) for text in ("0", "17", "0%", "50%", "12.5%", "100%")] == [
        *(0, 17, 0, 200, 50, 400)
    ]
    with pytest.raises(UserError):
        gaussians_to_keep("¾", 400)


def test_size_of_a_file():
    sizes = [file_size(text) for text in ("10MB", "0.5 gb", "800kB", "800", "50%", 7, None)]
    assert sizes == [10_000_000, 500_000_000, 800_000, None, None, None, None]


def test_invalid_edits():
    for edits, setting in (
        ({"sh_degree": 4}, "sh_degree"),
        ({"scale": 0.0}, "scale"),
        ({"crop": (0.0, 0.0, 0.0, 1.0, -1.0, 1.0)}, "crop"),
        ({"decimate": "101%"}, "decimate"),
    ):
        with pytest.raises(SettingError) as error:
            Edits(**edits)
        assert error.value.setting == setting


def test_two_scenes_are_merged(tmp_path):
    zeros = torch.zeros(3, 1, 3)
    one = Gaussians(
        torch.arange(9.0).reshape(3, 3),
        zeros[:, 0],
        torch.ones(3, 4),
        zeros[:, 0, 0],
        zeros,
        zeros[:, :0],
    )
    write_gaussians(tmp_path / "a.ply", one)
    edits = Edits(translate=(1.0, 0.0, 0.0), decimate=5)
    format = convert([tmp_path / "a.ply", tmp_path / "a.ply"], tmp_path / "b.ply", edits)
    assert format.name == "PLY"
    both = read_gaussians(tmp_path / "b.ply")
    assert len(both) == 5
    torch.testing.assert_close(both.means[:, 0].unique(), torch.tensor([1.0, 4.0, 7.0]))
    with pytest.raises(UserError, match="exists; use `overwrite`"):
        convert(tmp_path / "a.ply", tmp_path / "b.ply")


def test_versions_of_spz(tmp_path):
    zeros = torch.zeros(3, 1, 3)
    scene = Gaussians(
        zeros[:, 0], zeros[:, 0], torch.ones(3, 4), zeros[:, 0, 0], zeros, zeros[:, :0]
    )
    write_gaussians(tmp_path / "a.ply", scene)
    for given, written in ((None, "3"), (2, "2"), (3, "3"), (4, "4")):
        path = tmp_path / f"{given}.spz"
        convert(tmp_path / "a.ply", path, spz_version=given)
        assert spz_version(path) == written
        assert len(read_gaussians(path)) == 3
    edits = Edits(decimate="10KB")
    convert(tmp_path / "a.ply", tmp_path / "small.spz", edits, spz_version=2)
    assert spz_version(tmp_path / "small.spz") == "2"
    for name, version, message in (("b.spz", 1, "1 cannot"), ("b.sog", 2, "b.sog is SOG")):
        with pytest.raises(SettingError, match=message) as error:
            convert(tmp_path / "a.ply", tmp_path / name, spz_version=version)
        assert error.value.setting == "spz_version"
        assert not (tmp_path / name).exists()
