"""The table of all camera models, and `lens_of`, which finds one by its name."""

from __future__ import annotations

from collections.abc import Iterable

from snowsplat.data.lens import fisheye, perspective
from snowsplat.data.lens.brown import Brown
from snowsplat.data.lens.lens import Lens

#: The models of COLMAP; the index is the number of a model in its binary files.
COLMAP_LENSES: tuple[type[Lens], ...] = (
    perspective.SimplePinhole,
    perspective.Pinhole,
    perspective.SimpleRadial,
    perspective.Radial,
    perspective.OpenCV,
    fisheye.OpenCVFisheye,
    perspective.FullOpenCV,
    perspective.FieldOfView,
    fisheye.SimpleRadialFisheye,
    fisheye.RadialFisheye,
    fisheye.ThinPrismFisheye,
    fisheye.AriaFisheye,
    perspective.SimpleDivision,
    perspective.Division,
    fisheye.SimpleFisheye,
    fisheye.Fisheye,
    perspective.EnhancedUnified,
    fisheye.Equirectangular,
)
#: All models.
LENSES: tuple[type[Lens], ...] = (*COLMAP_LENSES, Brown)


def lens_of(model: str, width: int, height: int, params: Iterable[float]) -> Lens:
    """The lens of a model in `LENSES`; ``params`` are in the order of `Lens.parameters`."""
    return next(lens for lens in LENSES if lens.model == model)(width, height, tuple(params))
