"""`snowsplat convert`: a scene in another format, or edited."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from snowsplat.cli.command import JsonCommand, print_message, see_and_share
from snowsplat.cli.observer import TerminalObserver
from snowsplat.pipeline.options import common
from snowsplat.pipeline.options.scene import Edits
from snowsplat.util.byte_size import format_bytes
from snowsplat.util.errors import UserError
from snowsplat.util.messages import message
from snowsplat.util.settings import argument, group, setting, switch


@dataclass(frozen=True, kw_only=True)
class Convert(JsonCommand):
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

    paths: tuple[Path, ...] = argument(
        (),
        "SCENE [MORE …] FILE",
        "One or more scenes, followed by the file to write. A scene is a file of any format, an "
        "output folder, of which the last scene is used, or a folder with a lod-meta.json or a SOG "
        "meta.json.",
    )
    edits: Edits = group(Edits)
    refine: Path | None = setting(
        None,
        "With --decimate: train the result for a moment on the photos of the scene.",
        metavar="DATASET",
    )
    scale_to: str | None = setting(
        None,
        "The true distance of the two places of --between, e.g. 0.45m, 45cm, 17.7in: scale the "
        "scene so that one unit is one metre.",
        metavar="LENGTH",
    )
    between: tuple[str, str] = setting(
        ("", ""),
        "With --scale-to: two points X,Y,Z, or the names of two photos of an output folder.",
        "",
        metavar="A B",
    )
    spz_version: int | None = setting(
        None,
        "Version of an .spz file: 2 for older viewers, with coarser rotations; 4 for the newest "
        "viewers, faster to load.",
        "3",
        least=2,
        most=4,
        allowed="2, 3 or 4",
        metavar="{2,3,4}",
    )
    georeferenced: bool = switch(
        "Write positions in the world, as doubles (.ply), for a scene that is far away from 0. "
        "Without it, they are relative to the origin that is noted in the file or beside it."
    )
    overwrite: bool = common.overwrite()

    def run(self) -> dict[str, Any]:
        if len(self.paths) < 2:
            raise UserError("convert needs a scene and the name of a file to write")
        *sources, target = self.paths
        from snowsplat.pipeline.convert import convert
        from snowsplat.pipeline.true_scale import KnownDistance

        if self.scale_to is None and any(self.between):
            raise UserError("--between: how far is it? add --scale-to LENGTH, such as 0.45m")
        with TerminalObserver() as observer:
            format = convert(
                sources,
                target,
                self.edits,
                dataset=self.refine,
                spz_version=self.spz_version,
                georeferenced=self.georeferenced,
                known=KnownDistance(self.scale_to, self.between) if self.scale_to else None,
                overwrite=self.overwrite,
                observer=observer,
            )
        size = format.size(target)
        print_message(
            "{target}: {size} of {format}; lost in this format: {loses}",
            target=target,
            size=format_bytes(size),
            format=format.name,
            loses=format.loses,
        )
        to_see = see_and_share(target)
        if format.name == "HTML":
            to_see = message("to see it: open {target} in a browser", target=target)
        print_message(to_see)
        return {"file": target, "bytes": size, "format": format.name, "lost": format.loses}
