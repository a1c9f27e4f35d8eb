"""`snowsplat clean`: a scene without floaters."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from snowsplat.cli.flags import Threads, flag, switch
from snowsplat.cli.next_steps import see_and_share
from snowsplat.cli.observer import TerminalObserver
from snowsplat.cli.reports import JsonFlag, Reports
from snowsplat.util.errors import UserError
from snowsplat.util.messages import message


@dataclass
class Clean(Reports):
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

    scene: Annotated[Path | None, tyro.conf.Positional, flag("SCENE")] = None
    """The output folder of train or make, or a scene file of any format."""
    target: Annotated[Path | None, tyro.conf.Positional, flag("FILE")] = None
    """The file to write."""
    dataset: Annotated[Path | None, flag("DATASET", "-s", default="as trained")] = None
    """Folder of the dataset: for a scene file, or if it was moved after the training."""
    overwrite: Annotated[bool, switch()] = False
    """Replace FILE if it exists already."""
    threads: Threads = None
    device: Annotated[str | None, flag("{cuda,cuda:N,cpu}", default="a GPU if there is one")] = None
    """Device to compute on."""
    json: JsonFlag = False

    def run(self) -> int:
        if self.scene is None or self.target is None:
            raise UserError("clean needs a scene and the name of a file to write")
        from snowsplat.pipeline.clean import clean
        from snowsplat.pipeline.compute import Compute

        with TerminalObserver() as observer:
            done = clean(
                self.scene,
                self.target,
                dataset=self.dataset,
                overwrite=self.overwrite,
                compute=Compute(self.device, self.threads),
                observer=observer,
            )
        before, after = done.psnr
        print(
            message(
                "{target}: {after:,} of {before:,} Gaussians removed; PSNR of {compared} "
                "{before2:.2f} dB before, {after2:.2f} dB after",
                target=self.target,
                after=done.before - done.after,
                before=done.before,
                compared=done.compared,
                before2=before,
                after2=after,
            )
        )
        print(see_and_share(self.target))
        self.report = {"file": self.target, "bytes": self.target.stat().st_size, **vars(done)}
        return 0
