"""The flags of `snowsplat train` that are not settings of the configuration."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from snowsplat.cli.config_file import training_in
from snowsplat.cli.config_flags import RECIPE, RECIPE_FLAG, ConfigFlags, RecipeName
from snowsplat.cli.flags import Quiet, flag, switch
from snowsplat.cli.page_flags import AllowHost
from snowsplat.util.errors import UserError

if TYPE_CHECKING:
    from snowsplat.pipeline.train import TrainOptions
    from snowsplat.project.training_folder import DatasetSettings
    from snowsplat.training.settings.config import TrainConfig


@dataclass
class JobFlags:
    """The dataset, the output folder, the limits of time and memory, the page, and the device."""

    dataset: Annotated[Path | None, tyro.conf.Positional, flag("DATASET")] = None
    """Folder with photos and their cameras: images/ and a COLMAP model in sparse/0/, or
    transforms.json."""
    output: Annotated[Path | None, flag("OUT", "-o", "-m", "--model-path")] = None
    """Output folder. It is created if it does not exist."""

    recipe: Annotated[RecipeName | None, RECIPE_FLAG] = None
    """Named configuration, which determines the defaults of the other settings. default: 2000
    steps, designed for CPUs; classic: the default recipe of version 0.1; paper: the 30,000 steps of
    the paper; mcmc: 30,000 steps with a fixed maximum number of Gaussians; mcmc-short: the same in
    3000 steps."""
    config: Annotated[Path | None, flag("FILE")] = None
    """A JSON or TOML file with values of these flags, such as {"iterations": 3000, "eval": true},
    or the config.json of an earlier training, whose settings are used. Flags have priority."""
    minutes: Annotated[float | None, flag("F", default="none")] = None
    """Finish within this time, including evaluation and saving. The number of steps, the size of
    the photos and the maximum number of Gaussians are chosen for this time, unless flags set them.
    With --resume, this is the time for the remaining steps."""
    eval: Annotated[bool, switch()] = False
    """Hold out every 8th photo (or the test split of the dataset), and evaluate the scene on these
    photos at the end."""
    test_list: Annotated[Path | None, flag("FILE")] = None
    """Text file with the names of the photos to hold out, one per line. Implies --eval."""
    images: Annotated[str | None, flag("NAME", "-i", default="images")] = None
    """Name of the folder with the photos, in the folder of the dataset."""
    resolution: Annotated[int | None, flag("N", "-r", default="unchanged")] = None
    """With 1, 2, 4 or 8, the width and height of the photos are divided by this number. Any other
    number is the new width in pixels."""
    white_background: Annotated[bool, switch("-w")] = False
    """The same as --background white."""
    feature_lr: Annotated[float | None, flag("F", default=RECIPE)] = None
    """Set --lr-sh-dc to F and --lr-sh-rest to F/20, as in the reference implementation."""

    view: Annotated[bool, switch()] = False
    """Show the training in the browser: the scene, curves of loss and PSNR, and a button to pause.
    After the training, the page stays open until Ctrl-C."""
    port: Annotated[int | None, flag("N", default="8080, or the next free one")] = None
    """Port of the page. Its URL, which is printed, contains a secret token."""
    host: Annotated[str | None, flag("H", default="127.0.0.1, this computer only")] = None
    """Address to listen on. 0.0.0.0 accepts connections from the network."""
    allow_host: AllowHost = ()

    memory: Annotated[str | None, flag("BYTES", default="no limit")] = None
    """Memory limit of the training, for example 4GB. On a GPU, this is memory of the GPU; on the
    CPU, it is memory in addition to that of Python and its libraries. To stay within the limit,
    photos are decoded each time they are used, and the maximum number of Gaussians is reduced."""
    trust_cameras: Annotated[bool, switch()] = False
    """Train even if the cameras of the dataset contradict its photos or points, or have an
    impossible lens."""
    resume: Annotated[bool, switch()] = False
    """Continue from the newest checkpoint in OUT. The result is the same as without the
    interruption."""
    overwrite: Annotated[bool, switch()] = False
    """Replace the results of an earlier training run in OUT."""
    device: Annotated[str | None, flag("{cuda,cuda:N,cpu}", default="a GPU if there is one")] = None
    """Device to train on."""
    threads: Annotated[int | None, flag("N", default="all cores")] = None
    """Number of CPU threads. The result does not depend on this number."""
    processes: Annotated[int | None, flag("N", default="1")] = None
    """Distribute the Gaussians over N processes on this computer, which needs less memory per
    process. Use it with --batch of N or a multiple of N. With --deterministic or on a CPU, the
    result is the same as that of one process."""
    deterministic: Annotated[bool, switch()] = False
    """On a GPU, make the results of repeated runs bit-identical. This needs more time and
    memory."""
    save_iterations: Annotated[tuple[int, ...], flag("[N ...]")] = ()
    """Steps after which to save the scene, in addition to the last step."""
    source_path: Annotated[Path | None, flag("DATASET", "-s")] = None
    """The same as DATASET. This is the flag of the reference implementation."""
    log: Annotated[
        tuple[Literal["csv", "tensorboard"], ...], flag("[{csv,tensorboard} ...]", default="none")
    ] = ()
    """Also write loss, number of Gaussians and metrics of the steps: csv: to OUT/log.csv;
    tensorboard: to OUT/tensorboard, which needs the package snowsplat[tensorboard]."""
    quiet: Quiet = False


@dataclass
class TrainFlags(ConfigFlags, JobFlags):
    """All flags of `snowsplat train`."""

    def dataset_path(self) -> Path | None:
        """The dataset, or None. Raises: UserError: it is named twice."""
        if self.dataset is not None and self.source_path is not None:
            raise UserError("the dataset is named twice; leave out DATASET or -s")
        given = self.dataset or self.source_path
        if given is None and self.config is not None and not self.resume:
            earlier = self._earlier[1].path
            given = Path(earlier) if earlier else None
        return given

    @cached_property
    def _earlier(self) -> tuple[TrainConfig, DatasetSettings]:
        """The configuration and the dataset of the earlier training that is the configuration."""
        assert self.config is not None
        return training_in(self.config)

    def options(self) -> TrainOptions:
        """The options of `pipeline.train.train`. Raises: UserError: contradictory flags."""
        from snowsplat.pipeline.compute import Compute
        from snowsplat.pipeline.train import TrainOptions

        config, earlier = (None, None) if self.config is None else self._earlier
        before = {} if earlier is None else asdict(earlier)
        if self.eval or self.test_list is not None:
            before |= dict.fromkeys(("hold_out", "first_held_out", "test_list"))
        return TrainOptions(
            recipe=self.recipe,
            config=config,
            settings=self._settings(),
            images=before.get("images") if self.images is None else self.images,
            resolution=before.get("resolution") if self.resolution is None else self.resolution,
            hold_out=8 if self.eval else before.get("hold_out"),
            first_held_out=before.get("first_held_out"),
            test_list=self.test_list or before.get("test_list"),
            minutes=self.minutes,
            memory=self.memory,
            trust_cameras=self.trust_cameras,
            save_iterations=self.save_iterations,
            compute=Compute(self.device, self.threads, self.deterministic),
        )

    def _settings(self) -> dict[str, Any]:
        settings = self.config_settings()
        if self.white_background and settings.setdefault("background", "white") != "white":
            raise UserError("-w and --background set different colours; use one of them")
        if self.feature_lr is not None:
            settings = {"lr_sh_dc": self.feature_lr, "lr_sh_rest": self.feature_lr / 20} | settings
        return settings
