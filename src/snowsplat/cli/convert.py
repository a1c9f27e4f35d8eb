"""`snowsplat convert`: a scene in another format, or edited."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from snowsplat.cli.flags import flag, switch
from snowsplat.cli.next_steps import see_and_share
from snowsplat.cli.observer import TerminalObserver
from snowsplat.cli.reports import JsonFlag, Reports
from snowsplat.util.byte_size import format_bytes
from snowsplat.util.errors import UserError
from snowsplat.util.messages import message

Vector = tuple[float, float, float]
Box = tuple[float, float, float, float, float, float]


@dataclass
class Convert(Reports):
    """Write a scene in another file format; crop, decimate, transform or merge scenes.

    Examples:
      snowsplat convert out/garden garden.spz
      snowsplat convert garden.ply old.spz --spz-version 2
      snowsplat convert garden.ply for_the_web.sog --sh-degree 1 --decimate 10MB
      snowsplat convert out/garden small.ply --decimate 50% --refine garden
      snowsplat convert garden.ply table.glb --crop -1 -1 -1 1 0.5 1 --rotate 0 90 0
      snowsplat convert house.ply tree.spz both.ply
      snowsplat convert out/garden true.glb --scale-to 4.2m --between IMG_1 IMG_9
      snowsplat convert out/town town_levels/lod-meta.json

    The suffix of FILE selects the format:
      .ply              lossless; read by every program for Gaussian splats
      .compressed.ply   1/4 of the size of .ply; for SuperSplat
      .spz              1/8 of the size; for the programs of Niantic and many others
                        (older viewers need --spz-version 2)
      .sog              1/10 of the size; for the web viewers of PlayCanvas
      .glb              glTF; lossless except for rounding
      .usdz, .usd       OpenUSD; lossless except for rounding; needs snowsplat[usd]
      .splat            1/8 of the size; no view-dependent colour
      .html             a web page that contains the scene and a viewer
      lod-meta.json     a folder with levels of detail, for large scenes on the
                        web: viewers load first a coarse level, then what they
                        show; for the web viewers of PlayCanvas

    Notes:
      If there are several scenes, they are merged first. Then the edits are
      applied in this order: --crop, --sh-degree, --decimate, --rotate, --scale
      or --scale-to, --translate. Coordinates are in the frame of PLY files: x
      right, y down, z forward. They are those in the world, also for a scene far
      away from 0.
      --decimate is better with an output folder than with a scene file: the
      result is then trained to look like the whole scene from its cameras.
    """

    paths: Annotated[tuple[Path, ...], tyro.conf.Positional, flag("SCENE [MORE …] FILE")] = ()
    """One or more scenes, followed by the file to write. A scene is a file of any format, an output
    folder, of which the last scene is used, or a folder with a lod-meta.json or a SOG meta.json."""
    sh_degree: Annotated[int | None, flag("N", default="that of the scene")] = None
    """Reduce the spherical harmonics (view-dependent colour) to this degree, 0 to 3."""
    crop: Annotated[Box | None, flag("X0 Y0 Z0 X1 Y1 Z1", default="all")] = None
    """Keep only the Gaussians whose centres are in this box."""
    decimate: Annotated[str | None, flag("N|P%|SIZE", default="all")] = None
    """Number or percentage of Gaussians, or the size of FILE, e.g. 10MB. Neighbours are merged."""
    refine: Annotated[Path | None, flag("DATASET")] = None
    """With --decimate: train the result for a moment on the photos of the scene."""
    rotate: Annotated[Vector, flag("X Y Z", default="0 0 0")] = (0.0, 0.0, 0.0)
    """Rotate by these angles in degrees, first about x, then about y, then about z."""
    scale: Annotated[float, flag("F", default="1")] = 1.0
    """Scale by this factor about the origin."""
    scale_to: Annotated[str | None, flag("LENGTH")] = None
    """The true distance of the two places of --between, e.g. 0.45m, 45cm, 17.7in: scale the scene
    so that one unit is one metre."""
    between: Annotated[tuple[str, str], flag("A B")] = ("", "")
    """With --scale-to: two points X,Y,Z, or the names of two photos of an output folder."""
    translate: Annotated[Vector, flag("X Y Z", default="0 0 0")] = (0.0, 0.0, 0.0)
    """Translate by this offset."""
    spz_version: Annotated[Literal[2, 3, 4] | None, flag("{2,3,4}", default="3")] = None
    """Version of an .spz file: 2 for older viewers, with coarser rotations; 4 for the newest
    viewers, faster to load."""
    georeferenced: Annotated[bool, switch()] = False
    """Write positions in the world, as doubles (.ply), for a scene that is far away from 0. Without
    it, they are relative to the origin that is noted in the file or beside it."""
    overwrite: Annotated[bool, switch()] = False
    """Replace FILE if it exists already."""
    json: JsonFlag = False

    def run(self) -> int:
        if len(self.paths) < 2:
            raise UserError("convert needs a scene and the name of a file to write")
        *sources, target = self.paths
        from snowsplat.pipeline.convert import Edits, convert
        from snowsplat.pipeline.true_scale import KnownDistance

        if self.scale_to is None and any(self.between):
            raise UserError("--between: how far is it? add --scale-to LENGTH, such as 0.45m")
        edits = Edits(
            crop=self.crop,
            rotate=self.rotate,
            scale=self.scale,
            translate=self.translate,
            decimate=self.decimate,
            sh_degree=self.sh_degree,
        )
        with TerminalObserver() as observer:
            format = convert(
                sources,
                target,
                edits,
                dataset=self.refine,
                spz_version=self.spz_version,
                georeferenced=self.georeferenced,
                known=KnownDistance(self.scale_to, self.between) if self.scale_to else None,
                overwrite=self.overwrite,
                observer=observer,
            )
        size = format.size(target)
        written = f"{format_bytes(size)} of {format.name}"
        self.report = {"file": target, "bytes": size, "format": format.name, "lost": format.loses}
        print(
            message(
                "{target}: {written}; lost in this format: {loses}",
                target=target,
                written=written,
                loses=format.loses,
            )
        )
        page = format.name == "HTML"
        print(f"to see it: open {target} in a browser" if page else see_and_share(target))
        return 0
