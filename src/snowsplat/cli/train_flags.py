"""The flags of `snowsplat train` beside the settings of its configuration."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, get_args

import tyro

from snowsplat.cli.config_flags import RECIPE, ConfigFlags
from snowsplat.cli.flags import flag, switch
from snowsplat.pipeline.checkpoint_meta import Recipe
from snowsplat.pipeline.compute import Compute
from snowsplat.pipeline.train import TrainOptions
from snowsplat.util.errors import UserError


@dataclass
class JobFlags:
    """What to train on, for how long, and where the result goes."""

    dataset: Annotated[Path | None, tyro.conf.Positional, flag("DATASET")] = None
    """Folder of photos and cameras: images/ and sparse/0/ of COLMAP, or transforms.json."""
    output: Annotated[Path | None, flag("OUT", "-o", "-m", "--model-path")] = None
    """Folder for the result; created if missing."""

    recipe: Annotated[
        Recipe | None, flag(f"{{{','.join(get_args(Recipe))}}}", default="default")
    ] = None
    """Named configuration: the defaults of the other settings. default: 3000 fast steps; paper: the
    schedule of the paper, 30,000 steps; mcmc: 30,000 steps with a fixed maximum number of
    Gaussians."""
    minutes: Annotated[float | None, flag("F", default="none")] = None
    """Finish within this time, including evaluation and saving. The number of steps, the size of
    the photos and the number of Gaussians are chosen to fit, unless they are given. With --resume:
    the time for the remaining steps."""
    eval: Annotated[bool, switch()] = False
    """Hold out every 8th photo (or the test split of the dataset) and evaluate on these photos at
    the end."""
    test_list: Annotated[Path | None, flag("FILE")] = None
    """Text file with the names of the photos to hold out, one per line. Implies --eval."""
    images: Annotated[str | None, flag("NAME", "-i", default="images")] = None
    """Name of the folder of photos in the dataset."""
    resolution: Annotated[int | None, flag("N", "-r", default="unchanged")] = None
    """1, 2, 4 or 8 divide the size of the photos; any other number is a width in pixels."""
    white_background: Annotated[bool, switch("-w")] = False
    """The same as --background white."""
    feature_lr: Annotated[float | None, flag("F", default=RECIPE)] = None
    """Sets --lr-sh-dc F and --lr-sh-rest F/20, as in the reference implementation."""

    view: Annotated[bool, switch()] = False
    """Show the training in the browser: the scene, curves, a pause button. Ctrl-C closes it."""
    port: Annotated[int | None, flag("N", default="8080, or the next free one")] = None
    """Port of the page: http://localhost:N."""
    host: Annotated[str | None, flag("H", default="127.0.0.1, this computer only")] = None
    """Address to listen on. 0.0.0.0 accepts connections from the network; the printed URL contains
    a secret token."""

    memory: Annotated[str | None, flag("BYTES", default="available memory")] = None
    """Memory limit of the training, for example 4GB: memory of the GPU or, on the CPU, memory in
    addition to that of Python and its libraries. If needed, photos are decoded again for each use,
    and the number of Gaussians is reduced."""
    resume: Annotated[bool, switch()] = False
    """Continue from the newest checkpoint in OUT. The result is that of an uninterrupted
    training."""
    overwrite: Annotated[bool, switch()] = False
    """Replace a training that is in OUT."""
    device: Annotated[str | None, flag("{cuda,cuda:N,cpu}", default="a GPU if there is one")] = None
    """Device to compute on."""
    threads: Annotated[int | None, flag("N", default="all cores")] = None
    """Number of CPU threads. The result does not depend on it."""
    deterministic: Annotated[bool, switch()] = False
    """On a GPU: bit-identical results in every run, with more time and memory."""
    save_iterations: Annotated[tuple[int, ...], flag("[N ...]")] = ()
    """Steps after which to save the scene, in addition to the last one."""
    source_path: Annotated[Path | None, flag("DATASET", "-s")] = None
    """The same as DATASET; the spelling of the reference implementation."""
    quiet: Annotated[bool, switch("-q")] = False
    """Print only the result, no progress."""


@dataclass
class TrainFlags(ConfigFlags, JobFlags):
    """All flags of `snowsplat train`."""

    def dataset_path(self) -> Path | None:
        """The dataset, or None. Raises: UserError: it is named twice."""
        if self.dataset is not None and self.source_path is not None:
            raise UserError("the dataset is named twice; leave out DATASET or -s")
        return self.dataset or self.source_path

    def options(self) -> TrainOptions:
        """The options of `pipeline.train.train`. Raises: UserError: contradictory flags."""
        return TrainOptions(
            recipe=self.recipe,
            settings=self._settings(),
            images=self.images,
            resolution=self.resolution,
            hold_out=8 if self.eval else None,
            test_list=self.test_list,
            minutes=self.minutes,
            memory=self.memory,
            save_iterations=self.save_iterations,
            compute=Compute(self.device, self.threads, self.deterministic),
        )

    def _settings(self) -> dict[str, Any]:
        settings = self.config_settings()
        if self.white_background and settings.setdefault("background", "white") != "white":
            raise UserError("-w and --background set different colors; use one of them")
        if self.feature_lr is not None:
            settings = {
                "lr_sh_dc": self.feature_lr,
                "lr_sh_rest": self.feature_lr / 20,
            } | settings
        return settings
