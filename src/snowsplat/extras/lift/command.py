"""`snowsplat lift`: one photo and its depth map become a scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from snowsplat.cli.flags import Quiet, Threads, flag, switch
from snowsplat.cli.next_steps import see_and_share
from snowsplat.cli.observer import TerminalObserver
from snowsplat.cli.reports import JsonFlag, Reports
from snowsplat.util.duration import duration
from snowsplat.util.errors import UserError
from snowsplat.util.messages import message


@dataclass
class Lift(Reports):
    """Make a scene from one photo and its depth map.

    Examples:
      snowsplat lift room.jpg --depth room_depth.png -o room
      snowsplat lift room.jpg --model depth_anything_v2.onnx -o room --swing
      snowsplat lift garden/images/12.jpg --depth 12.npy --refine garden -o room

    Notes:
      OUT is an output folder as that of train: view, render, convert and info
      read it. What the photo does not show is empty. Models are files on this
      computer; snowsplat never downloads one.
    """

    photo: Annotated[Path | None, tyro.conf.Positional, flag("PHOTO")] = None
    """The photo."""
    output: Annotated[Path | None, flag("OUT", "-o")] = None
    """The output folder. It is created if it does not exist."""
    depth: Annotated[Path | None, flag("MAP")] = None
    """Depth map of the photo: PNG (8 or 16 bits), TIFF, NPY or EXR, of any size."""
    model: Annotated[Path | None, flag("PATH")] = None
    """Instead of a map: a network that estimates depth. An ONNX file, or a folder of the library
    transformers; for example, Depth Anything V2."""
    depth_is: Annotated[
        Literal["z", "distance", "disparity"] | None,
        flag("{z,distance,disparity}", default="z; disparity for a model"),
    ] = None
    """What the values are. z: the distance along the optical axis; distance: along the ray;
    disparity: inverse depth, known up to a factor."""
    near: Annotated[float | None, flag("F", default="from the map")] = None
    """Depth of the nearest pixel. Together with --far, sets the range of the depths of a map
    without units."""
    far: Annotated[float | None, flag("F", default="from the map")] = None
    """Depth of the farthest pixel."""
    focal: Annotated[float | None, flag("PIXELS", default="from EXIF data")] = None
    """Focal length in pixels of the photo as stored. Without EXIF data, that of the main camera of
    phones is assumed."""
    size: Annotated[int | None, flag("PIXELS", default="640")] = None
    """Pixels along the longer side. A larger photo is scaled down."""
    max_gaussians: Annotated[int | None, flag("N", default="one per pixel")] = None
    """Merge the pixels of uniform parts, until there are at most this many Gaussians."""
    edge: Annotated[float, flag("F", default="0.05")] = 0.05
    """Neighbouring pixels are on different surfaces if their depths differ by more than this
    share."""
    swing: Annotated[bool, switch()] = False
    """Also render swing.mp4, a video from viewpoints around that of the photo."""
    refine: Annotated[Path | None, flag("DATASET")] = None
    """A dataset of photos with camera poses that contains PHOTO. The depth is aligned to its
    points, and the scene is trained on all of its photos."""
    iterations: Annotated[int | None, flag("N", default="1000")] = None
    """Number of training steps with --refine."""
    eval: Annotated[bool, switch()] = False
    """With --refine: hold out every 8th photo, and evaluate the scene on these photos."""
    threads: Threads = None
    overwrite: Annotated[bool, switch()] = False
    """Replace an earlier scene in OUT."""
    quiet: Quiet = False
    json: JsonFlag = False

    def run(self) -> int:
        if self.photo is None or self.output is None:
            raise UserError(
                "lift needs a photo and an output folder: snowsplat lift PHOTO --depth MAP -o OUT"
            )
        if self.refine is None and (self.eval or self.iterations is not None):
            raise UserError("`eval` and `iterations` are about the training; set `refine` as well")
        if self.refine is not None and (self.size is not None or self.focal is not None):
            raise UserError(
                "`size` and `focal` are those of the dataset with `refine`; leave them out"
            )
        from snowsplat.extras.lift.lift import LiftOptions
        from snowsplat.extras.lift.lift_photo import DepthSource, lift_photo

        source = DepthSource(self.depth, self.model, self.depth_is, self.near, self.far)
        what = self.photo, self.output, source
        options = LiftOptions(self.edge, self.max_gaussians)
        given: dict[str, Any] = {
            "swing": self.swing,
            "threads": self.threads,
            "overwrite": self.overwrite,
        }
        if self.refine is None:
            size = 640 if self.size is None else self.size
            result = lift_photo(*what, options, size=size, focal=self.focal, **given)
        else:
            from snowsplat.extras.lift.refine_photo import refine_photo

            if self.iterations is not None:
                given["iterations"] = self.iterations
            given["hold_out"] = 8 if self.eval else None
            with TerminalObserver(self.quiet) as observer:
                result = refine_photo(*what, self.refine, options, observer=observer, **given)
        self.report = result
        if result.alignment is not None:
            fit = result.alignment
            print(
                message(
                    "depth aligned to {points:,} points: median error {error:.1f}% of the "
                    "disparity",
                    points=fit.points,
                    error=100 * fit.error,
                )
            )
        pixels, where = result.focal
        hint = "; set it with --focal" if where == "assumed" else ""
        print(
            message(
                "focal length: {pixels:.0f} pixels, {where}{hint}",
                pixels=pixels,
                where=where,
                hint=hint,
            )
        )
        print(
            message(
                "depth ({values_are}): {depths:.3g} to {depths2:.3g}",
                values_are=source.values_are,
                depths=result.depths[0],
                depths2=result.depths[1],
            )
        )
        print(
            message(
                "{scene}: {gaussians:,} Gaussians, PSNR {psnr:.2f} dB at the pose of the photo, "
                "{seconds}",
                scene=result.scene,
                gaussians=result.gaussians,
                psnr=result.psnr,
                seconds=duration(result.seconds),
            )
        )
        if result.evaluation is not None and result.evaluation.views:
            evaluation = result.evaluation
            print(
                message(
                    "held-out photos of {size}: PSNR {psnr:.2f} dB",
                    size=evaluation.size,
                    psnr=evaluation.psnr,
                )
            )
        if result.swing is not None:
            print(message("{swing}: the video", swing=result.swing))
        print(see_and_share(self.output))
        return 0
