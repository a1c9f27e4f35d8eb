"""The table of formats: the content has priority over the suffix; unknown files are refused."""

from pathlib import Path

import pytest
import torch

from snowsplat.formats import (
    FORMATS,
    format_for_reading,
    format_for_writing,
    read_gaussians,
    register_format,
    write_gaussians,
)
from snowsplat.scene.gaussians import Gaussians
from snowsplat.util.errors import UserError


def one() -> Gaussians:
    return Gaussians(
        torch.zeros(1, 3),
        torch.zeros(1, 3),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.zeros(1),
        torch.zeros(1, 1, 3),
        torch.zeros(1, 0, 3),
    )


def test_no_suffix_belongs_to_two_formats():
    suffixes = [suffix for format in FORMATS for suffix in format.suffixes]
    assert len(suffixes) == len(set(suffixes))
    assert all(s[0] in "./" and s == s.lower() for s in suffixes)
    assert len({format.name for format in FORMATS}) == len(FORMATS)


def test_a_format_is_registered_once():
    with pytest.raises(ValueError, match="already registered"):
        register_format(FORMATS[0])


@pytest.mark.parametrize(
    "format", [f for f in FORMATS if f.write and f.read], ids=lambda format: format.name
)
def test_the_suffix_selects_the_format_and_the_file_is_read_as_such(tmp_path, format):
    for suffix in format.suffixes:
        # Viewers know a complete name only in lower case.
        path = tmp_path / f"A scene{suffix if suffix[0] == '/' else suffix.upper()}"
        assert format_for_writing(path) is format
        write_gaussians(path, one())
        assert format_for_reading(path) is format
        assert len(read_gaussians(path)) == 1


@pytest.mark.parametrize(
    "format", [f for f in FORMATS if f.write and f.recognises], ids=lambda format: format.name
)
def test_the_content_has_priority_over_the_suffix(tmp_path, format):
    path = tmp_path / f"a{format.suffixes[0]}"
    write_gaussians(path, one())
    for other in ("scene", "scene.splat", "scene.ply", "scene.glb.spz"):
        renamed = tmp_path / other
        renamed.write_bytes(path.read_bytes())
        assert format_for_reading(renamed) is format


def test_only_formats_without_a_signature_are_selected_by_their_suffix():
    assert {f.name for f in FORMATS if f.read and not f.recognises} == {"splat", "ksplat"}


def test_unknown_formats_are_one_line_errors(tmp_path):
    path = tmp_path / "scene.obj"
    with pytest.raises(UserError, match=r"cannot be read \(No such file"):
        read_gaussians(path)
    path.write_bytes(b"v 1 2 3\n")
    with pytest.raises(UserError, match=r"not a known scene file; supported are .*\.ply") as error:
        read_gaussians(path)
    assert "\n" not in str(error.value)
    with pytest.raises(UserError, match="use snowsplat mesh or snowsplat points"):
        write_gaussians(path, one())
    path = tmp_path / "scene.txt"
    with pytest.raises(UserError, match=r"selects no scene format; use one of .*\.ply"):
        write_gaussians(path, one())
    with pytest.raises(UserError, match="cannot be read"):
        read_gaussians(tmp_path)


def test_formats_of_others_that_are_not_read_are_named_with_what_to_do(tmp_path):
    for name, head, advice in (
        ("a.rad", b"RAD0\x80", "build-lod --unlod --spz"),
        ("a-0.radc", b"RADC\x80", "build-lod --unlod --spz"),
        ("a.splat", b"RAD0\x80", "build-lod --unlod --spz"),
        ("a.lcc", b"{", "splat-transform"),
    ):
        (tmp_path / name).write_bytes(head)
        with pytest.raises(UserError, match=f"files cannot be read; .*{advice}"):
            read_gaussians(tmp_path / name)


def test_a_suffix_of_the_folder_is_ignored(tmp_path):
    folder = tmp_path / "v1.ply"
    folder.mkdir()
    with pytest.raises(UserError, match="selects no scene format"):
        format_for_writing(Path(folder) / "scene")


def test_every_format_states_what_it_loses(tmp_path):
    assert all(format.loses for format in FORMATS)
    versions = {".spz": "3", ".sog": "2", ".glb": "2, KHR_gaussian_splatting"}
    for suffix, version in versions.items():
        path = tmp_path / f"scene{suffix}"
        write_gaussians(path, one())
        format = format_for_reading(path)
        assert format.version is not None
        assert format.version(path) == version
