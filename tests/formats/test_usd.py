"""USD files: what OpenUSD reads in them, and what is read of those of other programs."""

import os
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from snowsplat.formats import format_for_reading, read_arrays, read_gaussians, usd, write_gaussians
from snowsplat.formats.usd import is_usd
from snowsplat.util import limited_child
from snowsplat.util.errors import UserError

ORIGIN = (500_000.0, 20.0, -5_400_000.0)

try:
    from pxr import Sdf, Usd, UsdGeom, UsdValidation, UsdVol

    installed = hasattr(UsdVol, "ParticleField3DGaussianSplat")
except ImportError:
    installed = False
with_usd = pytest.mark.skipif(not installed, reason="usd-core 26.3 or newer is not installed")


@pytest.fixture(autouse=True)
def _in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only one test waits for child processes."""
    monkeypatch.setattr(usd, "check_readable", lambda *_: None)


def test_a_usd_file_is_recognised(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also without OpenUSD, whose package is then named."""
    files = {"a.usda": b"#usda 1.0\n", "b.usd": b"PXR-USDC\0\0\0"}
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    with zipfile.ZipFile(tmp_path / "c.usdz", "w") as package:
        package.writestr("scene.usdc", b"PXR-USDC")
    assert {format_for_reading(file).name for file in tmp_path.iterdir()} == {"USD"}
    assert not is_usd(b"PK\x03\x04")
    assert not is_usd(b"ply\n")
    monkeypatch.setitem(__import__("sys").modules, "pxr", None)
    with pytest.raises(
        UserError, match=r"a.usda: USD files need .* 'snowsplat\[usd\]', or use .glb"
    ):
        read_arrays(tmp_path / "a.usda")


@with_usd
@pytest.mark.parametrize("suffix", [".usd", ".usda", ".usdc", ".usdz"])
def test_a_scene_comes_back(make_scene, tmp_path: Path, suffix: str) -> None:
    """With its unit, at its place; SH of every degree."""
    for degree, metres in enumerate((None, 1.0, 0.25, None)):
        scene = replace(make_scene(7, degree), metres_per_unit=metres, origin=ORIGIN)
        write_gaussians(tmp_path / f"a{suffix}", scene)
        back = read_gaussians(tmp_path / f"a{suffix}")
        world, expected = (s.means.double().numpy() + np.array(s.origin) for s in (back, scene))
        assert np.abs(world - expected).max() < 1e-3
        assert back.metres_per_unit == metres
        for name, tensor in scene.parameters().items():
            if name not in ("means", "quats"):
                assert torch.allclose(back.parameters()[name], tensor, atol=1e-4), name
        alike = (scene.rotations * back.rotations).sum(1).abs()
        assert (alike - 1).abs().max() < 1e-5
    assert os.listdir(tmp_path) == [f"a{suffix}"]


@with_usd
def test_what_openusd_reads(make_scene, tmp_path: Path) -> None:
    """The values of the schema: y up, metres, linear scales and opacities, real parts in place."""
    scene = replace(make_scene(5, 1), metres_per_unit=1.0)
    for name in ("a.usda", "a.usdz"):
        write_gaussians(tmp_path / name, scene)
        stage = Usd.Stage.Open(str(tmp_path / name))
        assert UsdGeom.GetStageUpAxis(stage) == "Y"
        assert UsdGeom.GetStageMetersPerUnit(stage) == 1
        assert stage.GetDefaultPrim().GetPath() == "/scene"
        splats = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/scene/splats"))
        up_back = np.array([1, -1, -1])
        positions = np.array(splats.GetPositionsAttr().Get())
        np.testing.assert_allclose(positions, scene.means.numpy() * up_back)
        np.testing.assert_allclose(splats.GetScalesAttr().Get(), scene.scales.numpy(), rtol=1e-6)
        opacities = splats.GetOpacitiesAttr().Get()
        np.testing.assert_allclose(opacities, scene.opacities.numpy(), rtol=1e-5)
        # A rotation by half a turn about x, before that of the Gaussian: wxyz -> (-x, w, -z, y).
        w, x, y, z = scene.rotations[0].tolist()
        real, *others = _unit(splats.GetOrientationsAttr().Get()[0])
        sign = np.sign(real / -x) if abs(x) > 1e-3 else 1.0
        turned = sign * np.array([real, *others])
        turns = [np.array([-x, w, -z, y]), np.array([w, x, -y, -z])]
        assert any(np.allclose(abs(turned @ turn), 1, atol=1e-5) for turn in turns)
        sh = np.array(splats.GetRadianceSphericalHarmonicsCoefficientsAttr().Get())
        assert sh.reshape(5, 4, 3)[:, 0] == pytest.approx(scene.sh_dc[:, 0].numpy())
        assert splats.GetRadianceSphericalHarmonicsDegreeAttr().Get() == 1
        low, high = np.array(splats.GetExtentAttr().Get())
        assert (low < positions).all()
        assert (positions < high).all()


def _unit(quat) -> np.ndarray:
    values = np.array([quat.real, *quat.imaginary])
    return values / np.linalg.norm(values)


@with_usd
def test_files_of_others(tmp_path: Path) -> None:
    """z up, 16 bits, defaults of the schema; errors in one line."""
    text = """#usda 1.0
    (
        upAxis = "Z"
        metersPerUnit = 0.01
    )
    def ParticleField3DGaussianSplat "a" { %s }
    """
    fields = """
    point3h[] positionsh = [(1, 2, 3), (0, 0, 1)]
    half3[] scalesh = [(1, 1, 2), (1, 1, 1)]
    double3 xformOp:translate = (0, 0, 10)
    uniform token[] xformOpOrder = ["xformOp:translate"]
    """
    (tmp_path / "a.usda").write_text(text % fields)
    found = read_arrays(tmp_path / "a.usda")
    np.testing.assert_allclose(found.world_means(), [[1, -13, 2], [0, -11, 0]])
    assert found.sh_rest.shape == (2, 0, 3)
    assert not found.sh_dc.any()
    assert (found.opacity_logits > 10).all()
    assert found.metres_per_unit == 0.01
    (tmp_path / "b.usda").write_text('#usda 1.0\n def Xform "a" {}\n')
    with pytest.raises(UserError, match="without visible Gaussian splats"):
        read_arrays(tmp_path / "b.usda")
    (tmp_path / "c.usdc").write_bytes(b"PXR-USDC" + bytes(200))
    with pytest.raises(UserError, match="c.usdc: OpenUSD reports"):
        read_arrays(tmp_path / "c.usdc")


@with_usd
def test_what_a_stage_says_of_its_splats(tmp_path: Path, caplog) -> None:
    """Visibility, instances, times, colour spaces."""
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, "Y")

    def define(path: str, x: float):
        splats = UsdVol.ParticleField3DGaussianSplat.Define(stage, path)
        splats.CreatePositionsAttr([(x, 0, 0)])
        return splats

    define("/plain", 1)
    UsdGeom.Imageable(define("/group/hidden", 2)).MakeInvisible()
    define("/shared/splats", 3)
    for name, y in (("a", 5), ("b", 6)):
        copy = UsdGeom.Xform.Define(stage, f"/{name}")
        copy.GetPrim().GetReferences().AddInternalReference("/shared")
        copy.GetPrim().SetInstanceable(True)
        copy.AddTranslateOp().Set((0, y, 0))
    define("/many/types/x/splats", 4)
    UsdGeom.Xform.Define(stage, "/many/types/x").AddTranslateOp().Set((0, 0, 1))
    many = UsdGeom.PointInstancer.Define(stage, "/many")
    many.CreatePrototypesRel().AddTarget("/many/types/x")
    many.CreateProtoIndicesAttr([0, 0, 0])
    many.CreatePositionsAttr([(0, 7, 0), (0, 8, 0), (0, 9, 0)])
    many.CreateInvisibleIdsAttr([1])
    moving = define("/moving", 0)
    moving.GetPositionsAttr().Clear()
    moving.GetPositionsAttr().Set([(10, 0, 0)], 1)
    moving.GetPositionsAttr().Set([(11, 0, 0)], 2)
    light = define("/light", 12).GetPrim()
    light.CreateAttribute("colorSpace:name", Sdf.ValueTypeNames.Token).Set("lin_rec709_scene")
    stage.Export(str(tmp_path / "a.usda"))
    with caplog.at_level("WARNING"):
        found = read_arrays(tmp_path / "a.usda").world_means() * (1, -1, -1)
    wanted = [
        (1, 0, 0),
        (3, 0, 0),
        (3, 5, 0),
        (3, 6, 0),
        (4, 7, 1),
        (4, 9, 1),
        (10, 0, 0),
        (12, 0, 0),
    ]
    np.testing.assert_allclose(sorted(map(tuple, found)), wanted)
    for text in (
        "1 prims with splats are invisible",
        "animated; read at the first time",
        "lin_rec709_scene",
    ):
        assert text in caplog.text


@pytest.mark.nightly  # to load the validators takes as long as all other tests of the formats
@with_usd
def test_the_validators_of_openusd(make_scene, tmp_path: Path) -> None:
    """All rules that its wheel has find nothing."""
    registry = UsdValidation.ValidationRegistry()
    names = [each.name for each in registry.GetAllValidatorMetadata()]
    context = UsdValidation.ValidationContext(registry.GetOrLoadValidatorsByName(names))
    for name in ("a.usda", "a.usdz"):
        write_gaussians(tmp_path / name, make_scene(5))
        errors = context.Validate(Usd.Stage.Open(str(tmp_path / name)))
        assert [error.GetErrorAsString() for error in errors] == []
    (tmp_path / "b.usda").write_text('#usda 1.0\ndef Xform "a" {}\n')
    assert context.Validate(Usd.Stage.Open(str(tmp_path / "b.usda")))  # no unit, no default prim


@with_usd
def test_files_are_read_in_a_child_process_first(make_scene, tmp_path: Path, monkeypatch) -> None:
    """OpenUSD takes 4 GB for a damaged file of 4 kB."""
    write_gaussians(tmp_path / "a.usdc", make_scene(5, 1))
    monkeypatch.setattr(usd, "check_readable", limited_child.check_readable)
    assert len(read_arrays(tmp_path / "a.usdc").means) == 5
    monkeypatch.setattr(limited_child, "_MEMORY", 1 << 22)
    with pytest.raises(UserError, match=r"a.usdc: .*; copy or export it again"):
        read_arrays(tmp_path / "a.usdc")
