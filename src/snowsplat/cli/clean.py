"""`snowsplat clean`: a scene without floaters."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from snowsplat.cli.command import JsonCommand, print_message, see_and_share
from snowsplat.cli.observer import TerminalObserver
from snowsplat.pipeline.compute import Compute
from snowsplat.pipeline.options import common
from snowsplat.util.messages import message
from snowsplat.util.settings import group, needed

_NEEDED = message("clean needs a scene and the name of a file to write")


@dataclass(frozen=True, kw_only=True)
class Clean(JsonCommand):
    """Remove floaters: Gaussians that hang in front of the surfaces.

    Examples:
      snowsplat clean out/garden garden.ply
      snowsplat clean garden.spz cleaned.spz --dataset garden

    Notes:
      Gaussians that no photo shows are removed, too. Floaters are removed as long
      as the PSNR of the held-out photos does not decrease. If no photos were held
      out, that of the training photos is used. Without photos, Gaussians are only
      removed if the renderings at their cameras hardly change.
      The suffix of FILE selects the format, as for snowsplat convert.
    """

    scene: Path = needed(
        _NEEDED,
        "SCENE",
        "The output folder of train or make, or a scene file of any format.",
        argument=True,
    )
    target: Path = needed(_NEEDED, "FILE", "The file to write.", argument=True)
    dataset: Path | None = common.dataset()
    overwrite: bool = common.overwrite()
    compute: Compute = group(Compute, only=("device", "threads"))

    def run(self) -> dict[str, Any]:
        from snowsplat.pipeline.clean import clean

        with TerminalObserver() as observer:
            done = clean(
                self.scene,
                self.target,
                dataset=self.dataset,
                overwrite=self.overwrite,
                compute=self.compute,
                observer=observer,
            )
        before, after = done.psnr
        print_message(
            "{target}: {after:,} of {before:,} Gaussians removed; PSNR of {compared} "
            "{before2:.2f} dB before, {after2:.2f} dB after",
            target=self.target,
            after=done.before - done.after,
            before=done.before,
            compared=done.compared,
            before2=before,
            after2=after,
        )
        print(see_and_share(self.target))
        return {"file": self.target, "bytes": self.target.stat().st_size, **vars(done)}
