"""OpenUSD files with a ParticleField3DGaussianSplat, the schema of OpenUSD 26.03 and newer.

`.usd`, `.usdc`, `.usda` and `.usdz` are written and read by the package usd-core, which is an
optional extra: `pip install "snowsplat[usd]"`.

The splats are one prim with arrays: positions; orientations; scales, the standard deviations
themselves; opacities in 0 … 1; and SH coefficients in the basis and order of our renderer, all
those of a particle together, the constant one first. Values of any of these arrays may have 16 bits
(`positionsh` …). The stage has y up: the frame of the prim is as in glTF (see `gltf`), its
translation is the `scene.origin`. A stage states a unit even where it is unknown, so
"metres_per_unit" in "snowsplat" of its customLayerData is 1 if it is known. The schema has no mark
for antialiased scenes. Specification: openusd.org, schema domain usdVol.
"""

import logging
import re
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from snowsplat.formats import packing
from snowsplat.formats.archive import first_member
from snowsplat.formats.damage import Damaged, Unsupported, reads
from snowsplat.formats.gaussian_arrays import GaussianArrays, usable_gaussians
from snowsplat.formats.gltf import place_in_scene
from snowsplat.scene.length import stored_metres
from snowsplat.scene.sh_constants import SH_REST_COUNTS
from snowsplat.util.errors import UserError
from snowsplat.util.files import new_entries
from snowsplat.util.limited_child import check_readable

logger = logging.getLogger(__name__)

_SUFFIXES = (".usdc", ".usda", ".usd")
_PRIM = "/scene/splats"
_OWN = "snowsplat"
_SPACE = "colorSpace:name"
_LIBRARIES = [f"pxr.{name}" for name in ("Sdf", "Tf", "UsdGeom", "UsdUtils", "UsdVol", "Vt")]
# Gaussians with all copies by instances and point instancers, at most, or one per byte of the file.
_MOST_REPEATED = 10_000_000
# The radius of a Gaussian in its extent, in standard deviations.
_RADIUS = 3.0


class _Prim(NamedTuple):
    splats: GaussianArrays  # in the frame of the prim
    places: list[np.ndarray]  # (4, 4) scene with y up from prim, one for each copy
    metres_per_unit: float | None  # of the stage
    notes: list[str]  # how the prim is, if a user should know


def is_usd(head: bytes) -> bool:
    """Whether a file that begins with ``head`` is a USD file or a USDZ package."""
    name = first_member(head)
    return head.startswith((b"PXR-USDC", b"#usda ")) or bool(name and name.endswith(_SUFFIXES))


@contextmanager
def open_usd(path: Path) -> Iterator[tuple[Any, ...]]:
    """Usd, UsdGeom, UsdUtils, UsdVol, Sdf and Vt of OpenUSD.

    Raises: UserError: they are not installed, or OpenUSD reports an error.
    """
    try:
        from pxr import Sdf, Tf, Usd, UsdGeom, UsdUtils, UsdVol, Vt

        UsdVol.ParticleField3DGaussianSplat  # noqa: B018 since OpenUSD 26.03
    except (ImportError, AttributeError):
        raise UserError(
            "{path}: USD files need OpenUSD 26.03 or newer; pip install 'snowsplat[usd]', or use "
            ".glb",
            path=path,
        ) from None
    try:
        yield Usd, UsdGeom, UsdUtils, UsdVol, Sdf, Vt
    except Tf.ErrorException as error:
        reason = re.sub(r"^.* : '|'$", "", str(error).strip().splitlines()[-1].strip())
        raise UserError(
            "{path}: OpenUSD reports: {reason}; copy or export it again",
            path=path,
            reason=reason[:200],
        ) from None


@reads
def read_usd(path: Path) -> GaussianArrays:
    """Read all splats of the stage, placed by their prims, as one set of Gaussians.

    Raises: UserError: usd-core is missing; the file cannot be read, is damaged, or has no splats.
    """
    path.open("rb").close()  # a clear error if that is not possible
    with open_usd(path):
        check_readable(prims_with_splats, path, _LIBRARIES)
    prims = prims_with_splats(path)
    notes = Counter(note for prim in prims for note in prim.notes)
    for note, count in notes.items():
        logger.warning("%s: %d prims with splats are %s", path, count, note)
    parts = [place_in_scene(prim.splats, place) for prim in prims for place in prim.places]
    if not parts:
        raise Unsupported(
            "a USD file without visible Gaussian splats (ParticleField3DGaussianSplat)"
        )
    scene = GaussianArrays.cat(parts)
    found = usable_gaussians(path, *packing.flip_axes(replace(scene, means=scene.world_means())))
    return replace(found, metres_per_unit=prims[0].metres_per_unit)


@reads
def prims_with_splats(path: Path) -> list[_Prim]:
    """The prims with splats in a file. Raises: as `read_usd`."""
    with open_usd(path) as (Usd, UsdGeom, _, UsdVol, _, _):
        stage = Usd.Stage.Open(str(path))
        # A stage whose unit is one metre says nothing: programs that do not know the unit write it.
        unit = UsdGeom.GetStageMetersPerUnit(stage)
        known = unit != 1.0 and UsdGeom.StageHasAuthoredMetersPerUnit(stage)
        metres = stored_metres(unit) if known else None
        own = stage.GetRootLayer().customLayerData.get(_OWN, {})
        if metres is None and isinstance(own, dict):
            metres = stored_metres(own.get("metres_per_unit"))
        # In a stage with z up, z becomes y, and y becomes -z.
        upright = np.eye(4)
        if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z:
            upright[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
        time = Usd.TimeCode.EarliestTime()
        places = UsdGeom.XformCache(time)
        found: list[_Prim] = []
        most = max(_MOST_REPEATED, path.stat().st_size)
        for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()):
            if not prim.IsA(UsdVol.ParticleField3DGaussianSplat):
                continue
            if UsdGeom.Imageable(prim).ComputeVisibility(time) == UsdGeom.Tokens.invisible:
                found.append(_Prim(GaussianArrays.empty(), [], metres, ["invisible, left out"]))
                continue
            splats, matrices = _splats(prim, time), _placed(UsdGeom, places, prim, time)
            most -= len(matrices) * len(splats.means)
            if most < 0:
                raise Damaged("it repeats its splats too often")
            notes = []
            if prim.GetAttribute("positions").ValueMightBeTimeVarying():
                notes.append("animated; read at the first time")
            space = next(filter(None, (p.GetAttribute(_SPACE).Get() for p in _upwards(prim))), "")
            if space and not space.startswith("srgb"):
                notes.append(f"in the colour space {space[:40]}; read as sRGB")
            placed = [upright @ matrix for matrix in matrices]
            found.append(_Prim(splats, placed, metres, notes))
    return found


def _upwards(prim: Any) -> Iterator[Any]:
    """A prim and its ancestors."""
    while prim:
        yield prim
        prim = prim.GetParent()


def _placed(UsdGeom: Any, places: Any, prim: Any, time: Any) -> list[np.ndarray]:
    """``world_from_prim`` (4, 4), of each copy if the prim is a prototype of a point instancer."""

    def world(of: Any) -> np.ndarray:  # USD multiplies rows by matrices from the right
        return np.array(places.GetLocalToWorldTransform(of)).T

    above = next((p for p in _upwards(prim) if p.IsA(UsdGeom.PointInstancer)), None)
    instancer: Any = UsdGeom.PointInstancer(above) if above else None
    roots = instancer.GetPrototypesRel().GetTargets() if above else []
    for number, root in enumerate(roots):
        if prim.GetPath().HasPrefix(root):
            inner = np.linalg.inv(world(prim.GetStage().GetPrimAtPath(root))) @ world(prim)
            every = instancer.ComputeInstanceTransformsAtTime(
                time, time, applyMask=UsdGeom.PointInstancer.IgnoreMask
            )
            shown = instancer.ComputeMaskAtTime(time) or [True] * len(every)
            used = zip(every, instancer.GetProtoIndicesAttr().Get(time), shown, strict=True)
            return [world(above) @ np.array(m).T @ inner for m, n, on in used if on and n == number]
    return [world(prim)]


def _splats(prim: Any, time: Any) -> GaussianArrays:
    """The splats of a prim in its frame. Raises: Damaged: lengths that do not match."""

    def read(name: str, width: int) -> np.ndarray | None:
        for each in (name, f"{name}h"):
            value = prim.GetAttribute(each).Get(time)
            if value is not None and len(value):
                return np.array(value, np.float32).reshape(-1, width)
        return None

    means = read("positions", 3)
    count = 0 if means is None else len(means)
    if means is None:
        return GaussianArrays.empty()

    def column(name: str, width: int, default: float) -> np.ndarray:
        """By the schema, longer arrays are cut and shorter ones are ignored."""
        values = read(name, width)
        if values is None or len(values) < count:
            return np.full((count, width), default, np.float32)
        return values[:count]

    stored = prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get(time)
    size = (int(stored if stored is not None else 3) + 1) ** 2
    sh = read("radiance:sphericalHarmonicsCoefficients", 3)
    if size < 1 or sh is None or len(sh) < count * size:
        sh = np.zeros((count, 3), np.float32)  # the constant colour 0.5
        size = 1
    sh = sh[: count * size].reshape(count, size, 3)[:, : 1 + SH_REST_COUNTS[-1]]
    return GaussianArrays(
        means,
        packing.log_scales(column("scales", 3, 1.0)),
        packing.quats_of_xyzw(column("orientations", 4, 0.0)),
        packing.logits(column("opacities", 1, 1.0)[:, 0]).astype(np.float32),
        np.ascontiguousarray(sh[:, :1]),
        np.ascontiguousarray(sh[:, 1:]),
    )


@np.errstate(over="ignore", under="ignore")
def write_usd(path: Path | str, gaussians: GaussianArrays) -> None:
    """Write one prim of splats, atomically; the suffix selects the kind of file.

    Raises:
        UserError: usd-core is missing.
        OSError: the folder is missing or not writable, or the disk is full.
    """
    path = Path(path)
    scene = packing.flip_axes(packing.packable(path, gaussians))
    means, quats = scene.means, scene.quats
    cut = packing.Cut(path, "USD", len(means))
    scales, opacities, sh = packing.linear_values(cut, scene)
    with open_usd(path) as (Usd, UsdGeom, UsdUtils, UsdVol, Sdf, Vt):
        kind = path.suffix.lower()
        layer = Sdf.Layer.CreateAnonymous(".usda" if kind == ".usda" else ".usdc")
        stage = Usd.Stage.Open(layer)
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, gaussians.metres_per_unit or 1.0)
        stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, str(Path(_PRIM).parent)).GetPrim())
        known = {"metres_per_unit": 1.0} if gaussians.metres_per_unit else {}
        layer.customLayerData = {_OWN: known}
        splats = UsdVol.ParticleField3DGaussianSplat.Define(stage, _PRIM)
        x, y, z = gaussians.origin
        if any(gaussians.origin):
            splats.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set((x, -y, -z))
        flat = np.ascontiguousarray
        splats.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(flat(means)))
        # Arrays of quaternions have the real part last.
        splats.CreateOrientationsAttr(Vt.QuatfArray.FromNumpy(flat(quats[:, [1, 2, 3, 0]])))
        splats.CreateScalesAttr(Vt.Vec3fArray.FromNumpy(flat(scales)))
        splats.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(opacities))
        splats.CreateRadianceSphericalHarmonicsDegreeAttr(SH_REST_COUNTS.index(sh.shape[1] - 1))
        splats.CreateRadianceSphericalHarmonicsCoefficientsAttr(
            Vt.Vec3fArray.FromNumpy(flat(sh.reshape(-1, 3)))
        )
        if len(means):
            reach = _RADIUS * scales.max(1, keepdims=True)
            corners = np.stack([(means - reach).min(0), (means + reach).max(0)])
            splats.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(corners.astype(np.float32)))
        with new_entries(path.parent, [path.name]) as new:
            # OpenUSD selects the kind of a file by its suffix.
            made, inner = new / f"made{kind}", new / f"made{kind.replace('z', 'c')}"
            layer.Export(str(inner))
            if kind == ".usdz":
                asset = Sdf.AssetPath(str(inner))
                UsdUtils.CreateNewUsdzPackage(asset, str(made), "scene.usdc")
            made.replace(new / path.name)
    cut.report(".ply keeps them")
