"""`snowsplat lift`: one photo and its depth map become a scene."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from snowsplat.cli.command import JsonCommand, print_message, see_and_share
from snowsplat.cli.observer import TerminalObserver
from snowsplat.extras.lift.options import DepthSource, LiftOptions
from snowsplat.pipeline.compute import Compute
from snowsplat.pipeline.options import common
from snowsplat.util.duration import duration
from snowsplat.util.errors import UserError
from snowsplat.util.messages import message
from snowsplat.util.settings import flag, group, needed, setting, switch

_NEEDED = message(
    "lift needs a photo and an output folder: snowsplat lift PHOTO --depth MAP -o OUT"
)


@dataclass(frozen=True, kw_only=True)
class Lift(JsonCommand):
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

    photo: Path = needed(_NEEDED, "PHOTO", "The photo.", argument=True)
    output: Path = needed(
        _NEEDED, "OUT", "The output folder. It is created if it does not exist.", "-o"
    )
    source: DepthSource = group(DepthSource)
    focal: float | None = setting(
        None,
        "Focal length in pixels of the photo as stored. Without EXIF data, that of the main camera "
        "of phones is assumed.",
        "from EXIF data",
        metavar="PIXELS",
    )
    size: int | None = setting(
        None,
        "Pixels along the longer side. A larger photo is scaled down.",
        "640",
        metavar="PIXELS",
    )
    options: LiftOptions = group(LiftOptions)
    swing: bool = switch("Also render swing.mp4, a video from viewpoints around that of the photo.")
    refine: Path | None = setting(
        None,
        "A dataset of photos with camera poses that contains PHOTO. The depth is aligned to its "
        "points, and the scene is trained on all of its photos.",
        metavar="DATASET",
    )
    iterations: int = flag(1000, "Number of training steps with --refine.")
    eval: bool = switch(
        "With --refine: hold out every 8th photo, and evaluate the scene on these photos."
    )
    compute: Compute = group(Compute, only=("threads",))
    overwrite: bool = common.overwrite("Replace an earlier scene in OUT.")
    quiet: bool = common.quiet()

    def run(self) -> Any:
        if self.refine is None and (self.eval or "iterations" in self.given):
            raise UserError("`eval` and `iterations` are about the training; set `refine` as well")
        if self.refine is not None and (self.size is not None or self.focal is not None):
            raise UserError(
                "`size` and `focal` are those of the dataset with `refine`; leave them out"
            )
        from snowsplat.extras.lift.lift_photo import lift_photo

        what = self.photo, self.output, self.source
        given: dict[str, Any] = {
            "swing": self.swing,
            "threads": self.compute.threads,
            "overwrite": self.overwrite,
        }
        if self.refine is None:
            size = 640 if self.size is None else self.size
            result = lift_photo(*what, self.options, size=size, focal=self.focal, **given)
        else:
            from snowsplat.extras.lift.refine_photo import refine_photo

            given |= {"iterations": self.iterations, "hold_out": 8 if self.eval else None}
            with TerminalObserver(self.quiet) as observer:
                result = refine_photo(*what, self.refine, self.options, observer=observer, **given)
        if result.alignment is not None:
            fit = result.alignment
            print_message(
                "depth aligned to {points:,} points: median error {error:.1f}% of the disparity",
                points=fit.points,
                error=100 * fit.error,
            )
        pixels, where = result.focal
        hint = message("; set it with --focal") if where == "assumed" else ""
        print_message(
            "focal length: {pixels:.0f} pixels, {where}{hint}",
            pixels=pixels,
            where=where,
            hint=hint,
        )
        print_message(
            "depth ({values_are}): {depths:.3g} to {depths2:.3g}",
            values_are=self.source.values_are,
            depths=result.depths[0],
            depths2=result.depths[1],
        )
        print_message(
            "{scene}: {gaussians:,} Gaussians, PSNR {psnr:.2f} dB at the pose of the photo, "
            "{seconds}",
            scene=result.scene,
            gaussians=result.gaussians,
            psnr=result.psnr,
            seconds=duration(result.seconds),
        )
        if result.evaluation is not None and result.evaluation.views:
            evaluation = result.evaluation
            print_message(
                "held-out photos of {size}: PSNR {psnr:.2f} dB",
                size=evaluation.size,
                psnr=evaluation.psnr,
            )
        if result.swing is not None:
            print_message("{swing}: the video", swing=result.swing)
        print(see_and_share(self.output))
        return result
