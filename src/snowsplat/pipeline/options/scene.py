"""`Edits`, `MeshOptions`, `PublishOptions`: options of what is made of a finished scene."""

import re
from dataclasses import dataclass
from importlib.util import find_spec

from snowsplat.util.errors import SettingError
from snowsplat.util.settings import Settings, flag, setting, switch

Vector = tuple[float, float, float]
Box = tuple[float, float, float, float, float, float]

_UNITS = {"kb": 1000, "mb": 1000**2, "gb": 1000**3}


def gaussians_to_keep(decimate: int | str, count: int) -> int:
    """How many of ``count`` Gaussians a number (5000, "5000") or a percentage ("50%") keeps.

    Raises: SettingError: ``decimate`` is neither.
    """
    text = str(decimate)
    if re.fullmatch(r"\d+", text):
        return int(text)
    match = re.fullmatch(r"(\d+(?:\.\d+)?)%", text)
    if not match or float(match[1]) > 100:
        raise SettingError(
            "decimate",
            "{text!r} is not valid; use a number, 0% to 100%, or a size such as 10MB",
            text=text,
        )
    return round(count * float(match[1]) / 100)


def file_size(decimate: int | str | None) -> int | None:
    """The bytes that a size such as "10MB", "0.5 GB" or "800KB" stands for; None: not a size."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?) ?([kmg]b)", str(decimate).lower())
    return round(float(match[1]) * _UNITS[match[2]]) if match else None


@dataclass(frozen=True)
class Edits(Settings):
    """Changes to a scene. The frame is that of a PLY: x right, y down, z forward.

    Attributes:
        crop: x, y, z of the lower corner and x, y, z of the upper corner.

    Raises:
        UserError: a value out of its range.
    """

    sh_degree: int | None = flag(
        None,
        "Reduce the spherical harmonics (view-dependent colour) to this degree, 0 to 3.",
        "that of the scene",
        least=0,
        most=3,
        allowed="0 to 3",
    )
    crop: Box | None = setting(
        None,
        "Keep only the Gaussians whose centres are in this box.",
        "all",
        metavar="X0 Y0 Z0 X1 Y1 Z1",
    )
    decimate: int | str | None = setting(
        None,
        "Number or percentage of Gaussians, or the size of FILE, e.g. 10MB. Neighbours are merged.",
        "all",
        parse=str,
        metavar="N|P%|SIZE",
    )
    rotate: Vector = setting(
        (0.0, 0.0, 0.0),
        "Rotate by these angles in degrees, first about x, then about y, then about z.",
        metavar="X Y Z",
    )
    scale: float = flag(1.0, "Scale by this factor about the origin.", above=0.0)
    translate: Vector = setting((0.0, 0.0, 0.0), "Translate by this offset.", metavar="X Y Z")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.crop and any(
            low > high for low, high in zip(self.crop[:3], self.crop[3:], strict=True)
        ):
            raise SettingError("crop", "the corners are swapped; give the lower corner first")
        if self.decimate is not None and file_size(self.decimate) is None:
            gaussians_to_keep(self.decimate, 0)


def _length(help: str, default: str) -> float | None:
    return setting(None, help, default, above=0.0, metavar="LENGTH")


def _installed(triangles: int) -> str | None:
    package = "needs the package fast-simplification: pip install 'snowsplat[mesh]'"
    return None if find_spec("fast_simplification") else f"{package}; or leave it out"


@dataclass(frozen=True)
class MeshOptions(Settings):
    """How surfaces become triangles. Lengths are in world units.

    Attributes:
        voxel: default: more than 2 widths of a pixel if the voxels would not fit into memory.
    """

    voxel: float | None = _length(
        "Side of the voxels in which the depth maps are fused: the smallest detail.",
        "2 pixels of the photos",
    )
    far: float | None = _length(
        "Leave out what is farther than this from every camera.", "3 times the median depth"
    )
    parts: float = setting(
        0.01,
        "Leave out connected parts that are smaller than this share of the largest one.",
        least=0.0,
        most=1.0,
        metavar="SHARE",
    )
    triangles: int | None = flag(
        None,
        "Simplify the mesh to about this number: 5000 for collisions in a game.",
        "all",
        least=4,
        check=_installed,
    )
    fill_holes: bool = switch("Close holes with flat triangles, as 3D printing needs it.")
    gaussians_only: bool = switch("Do not compare the photos: for photos that are renders.")


def _problem(url: str) -> str | None:
    known = not url or re.fullmatch(r"https?://[^\s\"<>?#]+", url)
    return None if known else "is no address; use e.g. https://host/garden/"


@dataclass(frozen=True)
class PublishOptions(Settings):
    """Options of a published scene.

    Attributes:
        title: None: the name of the scene.
        licence: such as "CC BY 4.0".
        for_editing: the page is not to be looked at: it has all Gaussians, even of a large scene,
            without what their colours owe to the direction of view.

    Raises:
        UserError: the address is not one.
    """

    title: str | None = flag(None, "The name of the scene on the page.", "the name of the scene")
    licence: str = flag("", "The licence of the scene.", "not stated")
    url: str = setting(
        "",
        "The address of the folder on the web, for the picture in previews of links.",
        "not known",
        check=_problem,
        metavar="URL",
    )
    walk: bool = switch(
        "Let people walk through the scene, on its ground and stopped by its walls."
    )
    for_editing: bool = False
