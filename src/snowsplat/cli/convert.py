"""`snowsplat convert`: a scene in another format, or changed."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from snowsplat.cli.flags import flag, switch
from snowsplat.cli.scene import cameras_of, folder_around, scene_file
from snowsplat.util.errors import UserError

if TYPE_CHECKING:
    from snowsplat.scene.camera import Camera
    from snowsplat.scene.gaussians import Gaussians
    from snowsplat.scene.geometry import Similarity

Vector = tuple[float, float, float]
Box = tuple[float, float, float, float, float, float]


@dataclass
class Convert:
    """Write a scene in another format; or cut, thinned out, turned, put together with others.

    Examples:
      snowsplat convert out/garden garden.spz
      snowsplat convert garden.ply for_the_web.sog --sh-degree 1 --decimate 50%
      snowsplat convert garden.ply table.glb --crop -1 -1 -1 1 0.5 1 --rotate 0 90 0
      snowsplat convert house.ply tree.spz both.ply

    The name of FILE says its format:
      .ply              all of it; what every program for splats reads
      .compressed.ply   a quarter of that, for SuperSplat
      .spz              an eighth, for Niantic's and many other programs
      .sog              a tenth, for PlayCanvas' viewers on the web
      .glb              all of it, as glTF
      .splat            without view-dependent colour
      .html             a page with a viewer, to send by mail

    Several scenes become one. Then, in this order: --crop, --rotate, --scale, --translate,
    --decimate, --sh-degree. Coordinates are those of a PLY: x right, y down, z forward.
    """

    paths: Annotated[tuple[Path, ...], tyro.conf.Positional, flag("SCENE [MORE …] FILE")] = ()
    """Scene files of any format or output folders of trainings, whose last scene is taken; last,
    the file to write."""
    sh_degree: Annotated[int | None, flag("N", default="that of the scene")] = None
    """0 to 3: how much view-dependent colour to keep."""
    crop: Annotated[Box | None, flag("X0 Y0 Z0 X1 Y1 Z1", default="all")] = None
    """Keep what is in this box."""
    decimate: Annotated[str | None, flag("N|P%", default="all")] = None
    """Keep so many Gaussians, or so many of a hundred: the largest and most opaque."""
    rotate: Annotated[Vector, flag("X Y Z", default="0 0 0")] = (0.0, 0.0, 0.0)
    """Degrees to turn about x, then about y, then about z."""
    scale: Annotated[float, flag("F", default="1")] = 1.0
    """Times as large, about the origin."""
    translate: Annotated[Vector, flag("X Y Z", default="0 0 0")] = (0.0, 0.0, 0.0)
    """Move by this."""
    overwrite: Annotated[bool, switch()] = False
    """Replace FILE if it is there."""

    def run(self) -> int:
        """Gives the exit code, 0."""
        if len(self.paths) < 2:
            raise UserError("convert needs a scene and the name of a file to write")
        *sources, target = self.paths
        self._check(target)
        from snowsplat.pipeline.convert import format_for_writing, read_gaussians, write_gaussians
        from snowsplat.scene import edit

        format = format_for_writing(target)
        movement = self._movement()
        files = [scene_file(source) for source in sources]
        scene = self._changed(edit.merge([read_gaussians(file) for file in files]), movement)
        if format.name == "HTML" and len(files) == 1 and movement is None:
            _write_page(target, scene, cameras_of(folder_around(files[0])))
        else:
            write_gaussians(target, scene)
        written = f"{target.stat().st_size:,} bytes of {format.name}"
        print(f"{target}: {written}; lost in this format: {format.loses}")
        return 0

    def _check(self, target: Path) -> None:
        if target.is_dir():
            raise UserError(f"{target}: is a folder; name a file to write, last")
        if target.exists() and not self.overwrite:
            raise UserError(f"{target}: exists; add --overwrite to replace it")
        if self.sh_degree is not None and not 0 <= self.sh_degree <= 3:
            raise UserError(f"--sh-degree is {self.sh_degree}; it must be 0 to 3")
        if not all(map(math.isfinite, (*self.rotate, *self.translate, *(self.crop or ())))):
            raise UserError("--rotate, --translate and --crop take finite numbers")
        if not 0 < self.scale < math.inf:
            raise UserError(f"--scale is {self.scale}; it must be more than 0")
        if self.crop and any(
            low > high for low, high in zip(self.crop, self.crop[3:], strict=False)
        ):
            raise UserError("--crop: give the lower corner first, then the higher one")
        if self.decimate is not None:
            _keep(self.decimate, 0)

    def _changed(self, scene: Gaussians, movement: Similarity | None) -> Gaussians:
        import torch

        from snowsplat.scene import edit

        if self.crop:
            before = len(scene)
            scene = edit.crop(scene, torch.tensor(self.crop).reshape(2, 3))
            if before and not len(scene):
                raise UserError("--crop: none of the Gaussians is in this box; see snowsplat info")
        if movement:
            scene = edit.transform(scene, movement)
        if self.decimate is not None:
            scene = edit.decimate(scene, _keep(self.decimate, len(scene)))
        if self.sh_degree is not None:
            scene = edit.with_sh_degree(scene, self.sh_degree)
        return scene

    def _movement(self) -> Similarity | None:
        """Old frame to new one; None where nothing moves, so that not a bit of it changes."""
        if not any(self.rotate) and self.scale == 1 and not any(self.translate):
            return None
        import torch

        from snowsplat.scene.geometry import Similarity, rotation_from_quat

        rotation = torch.eye(3, dtype=torch.float64)
        for axis, degrees in enumerate(self.rotate):
            half = math.radians(degrees) / 2
            quat = torch.zeros(4, dtype=torch.float64)
            quat[0], quat[1 + axis] = math.cos(half), math.sin(half)
            rotation = rotation_from_quat(quat) @ rotation
        return Similarity(self.scale, rotation, torch.tensor(self.translate, dtype=torch.float64))


def _write_page(target: Path, scene: Gaussians, cameras: list[Camera]) -> None:
    """A page that starts where a photo was taken, if it is known where."""
    from snowsplat.viewer.web.html import write_html
    from snowsplat.viewer.web.scene import ready

    write_html(target, *ready(scene, cameras))


def _keep(text: str, count: int) -> int:
    """How many of ``count`` are meant by a number or a percentage.

    Raises:
        UserError: neither.
    """
    if re.fullmatch(r"\d+", text):
        return int(text)
    match = re.fullmatch(r"(\d+(?:\.\d+)?)%", text)
    if not match or float(match[1]) > 100:
        raise UserError(f"--decimate is {text!r}; it must be a number, or 0% to 100%")
    return round(count * float(match[1]) / 100)
