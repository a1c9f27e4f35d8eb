"""`LiftOptions`, `DepthSource`: what one can set of a lifted photo. It imports nothing slow."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from snowsplat.util.errors import UserError
from snowsplat.util.settings import Settings, flag, setting

DepthKind = Literal["z", "distance", "disparity"]
#: The largest difference of the depths of linked neighbours, relative to the larger depth.
EDGE_THRESHOLD = 0.05


@dataclass(frozen=True)
class LiftOptions(Settings):
    """How a photo becomes Gaussians.

    Raises:
        SettingError: a value is not positive.
    """

    max_gaussians: int | None = flag(
        None,
        "Merge the pixels of uniform parts, until there are at most this many Gaussians.",
        "one per pixel",
        least=1,
    )
    edge: float = flag(
        EDGE_THRESHOLD,
        "Neighbouring pixels are on different surfaces if their depths differ by more than this "
        "share.",
        above=0.0,
        allowed="a positive share, e.g. 0.05",
    )


@dataclass(frozen=True)
class DepthSource(Settings):
    """Where the depth comes from: a file, or a network that is on disk; see `read_depth`.

    Exactly one of ``map`` and ``model`` is set.

    Raises:
        UserError: neither or both of ``map`` and ``model`` are set.
    """

    map: Path | None = setting(
        None,
        "Depth map of the photo: PNG (8 or 16 bits), TIFF, NPY or EXR, of any size.",
        name="depth",
        metavar="MAP",
    )
    model: Path | None = setting(
        None,
        "Instead of a map: a network that estimates depth. An ONNX file, or a folder of the "
        "library transformers; for example, Depth Anything V2.",
        metavar="PATH",
    )
    kind: DepthKind | None = flag(
        None,
        "What the values are. z: the distance along the optical axis; distance: along the ray; "
        "disparity: inverse depth, known up to a factor.",
        "z; disparity for a model",
        name="depth_is",
    )
    near: float | None = flag(
        None,
        "Depth of the nearest pixel. Together with --far, sets the range of the depths of a map "
        "without units.",
        "from the map",
    )
    far: float | None = flag(None, "Depth of the farthest pixel.", "from the map")

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.map is None) == (self.model is None):
            raise UserError(
                "lift needs either a depth map or a model; set one of `depth` and `model`"
            )

    @property
    def values_are(self) -> DepthKind:
        """``kind`` or its default."""
        return self.kind or ("z" if self.model is None else "disparity")
