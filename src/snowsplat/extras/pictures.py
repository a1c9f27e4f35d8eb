"""`write_pictures`: pictures and their cameras as a dataset, for `train` and what follows it."""

from collections.abc import Sequence
from pathlib import Path

from torch import Tensor

from snowsplat.pipeline.output.image_files import write_png
from snowsplat.scene.camera import Camera
from snowsplat.scene.render import to_8bit
from snowsplat.util.files import write_json


def write_pictures(
    folder: Path, names: Sequence[str], photos: Sequence[Tensor], cameras: Sequence[Camera]
) -> None:
    """Write photos (H, W, 3) in 0..1 with their poses in place of earlier ones.

    ``names``: without suffix; there may be more of them than photos.
    """
    (folder / "images").mkdir(parents=True, exist_ok=True)
    for earlier in (folder / "images").iterdir():
        earlier.unlink()
    frames = []
    for photo, camera, name in zip(photos, cameras, names, strict=False):
        write_png(folder / "images" / f"{name}.png", to_8bit(photo))
        pose = camera.world_from_cam
        pose[:, 1:3] *= -1  # the axes of the format
        frame = {"file_path": f"images/{name}.png", "w": camera.width, "h": camera.height}
        frame |= {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
        frames.append(frame | {"transform_matrix": [*pose.tolist(), [0, 0, 0, 1]]})
    write_json(folder / "transforms.json", {"frames": frames})
