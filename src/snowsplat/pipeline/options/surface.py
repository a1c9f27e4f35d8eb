"""`MeshOptions`: what one can set of a mesh or a dense point cloud."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec

from snowsplat.util.settings import Settings, setting, switch


def _length(help: str, default: str) -> float | None:
    allowed = "a number above 0"
    return setting(None, help, default, above=0.0, allowed=allowed, metavar="LENGTH")


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
    triangles: int | None = setting(
        None,
        "Simplify the mesh to about this number: 5000 for collisions in a game.",
        "all",
        least=4,
        check=_installed,
        metavar="N",
    )
    fill_holes: bool = switch("Close holes with flat triangles, as 3D printing needs it.")
