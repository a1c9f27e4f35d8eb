"""The table of all camera models, and `lens_of`, which finds one by its name."""

from __future__ import annotations

from collections.abc import Sequence

from snowsplat.data.lens.brown import Brown
from snowsplat.data.lens.fisheye import (
    AriaFisheye,
    Equirectangular,
    Fisheye,
    OpenCVFisheye,
    RadialFisheye,
    SimpleFisheye,
    SimpleRadialFisheye,
    ThinPrismFisheye,
)
from snowsplat.data.lens.lens import Lens
from snowsplat.data.lens.perspective import (
    Division,
    EnhancedUnified,
    FieldOfView,
    FullOpenCV,
    OpenCV,
    Pinhole,
    Radial,
    SimpleDivision,
    SimplePinhole,
    SimpleRadial,
)

#: The models of COLMAP; the index is the number of a model in its binary files.
COLMAP_LENSES: tuple[type[Lens], ...] = (
    SimplePinhole,
    Pinhole,
    SimpleRadial,
    Radial,
    OpenCV,
    OpenCVFisheye,
    FullOpenCV,
    FieldOfView,
    SimpleRadialFisheye,
    RadialFisheye,
    ThinPrismFisheye,
    AriaFisheye,
    SimpleDivision,
    Division,
    SimpleFisheye,
    Fisheye,
    EnhancedUnified,
    Equirectangular,
)
#: All models by name.
LENSES: dict[str, type[Lens]] = {lens.model: lens for lens in (*COLMAP_LENSES, Brown)}


def lens_of(model: str, width: int, height: int, params: Sequence[float]) -> Lens:
    """The lens of a model in `LENSES`; ``params`` are in the order of `Lens.parameters`."""
    return LENSES[model](width, height, tuple(params))
