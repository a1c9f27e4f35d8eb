"""`snowsplat benchmark`: all scenes of a benchmark suite, and a table."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from snowsplat.cli.config_flags import RECIPE, RECIPE_FLAG, RecipeName
from snowsplat.cli.flags import flag
from snowsplat.cli.reports import JsonFlag, Reports
from snowsplat.util.errors import UserError
from snowsplat.util.messages import message


@dataclass
class Benchmark(Reports):
    """Train and evaluate all scenes of a folder by the protocol of the papers.

    Examples:
      snowsplat benchmark 360_v2 -o out/360
      snowsplat benchmark nerf_synthetic -o out/blender --recipe paper
      snowsplat benchmark my_scenes -o out/mine -r 4 --jobs 2

    Notes:
      The protocol (sizes of photos, held-out photos, background) is that of the
      suite, which is recognised by the names of the scenes. OUT/index.html shows
      the results beside published ones; there are tables as CSV and LaTeX, too.
      Ctrl-C stops; the same command continues. Scenes that are finished are not
      repeated. Several computers with a shared folder can run the same command:
      each trains the scenes that no other one trains.
    """

    folder: Annotated[Path | None, tyro.conf.Positional, flag("FOLDER")] = None
    """Contains one folder for each scene."""
    output: Annotated[Path | None, flag("OUT", "-o")] = None
    """A folder for the scenes and the tables."""
    suite: Annotated[
        Literal["mipnerf360", "tandt", "db", "blender", "custom"] | None,
        flag("{mipnerf360,tandt,db,blender,custom}", default="by the names of the scenes"),
    ] = None
    """The benchmark suite."""
    scenes: Annotated[tuple[str, ...], flag("[NAME ...]", default="all")] = ()
    """Only these scenes."""
    recipe: Annotated[RecipeName, RECIPE_FLAG] = "default"
    """The recipe of the training."""
    iterations: Annotated[int | None, flag("N", default=RECIPE)] = None
    """Number of training steps."""
    max_gaussians: Annotated[int | None, flag("N", default=RECIPE)] = None
    """Maximum number of Gaussians; 0: no limit."""
    resolution: Annotated[int | None, flag("N", "-r", default="set by the suite")] = None
    """1, 2, 4 or 8: divide the size of the photos by this number; another number: the width."""
    lpips: Annotated[Path | None, flag("{vgg,alex,FILE}", default="not measured")] = None
    """Network for LPIPS, or a file with its weights, see snowsplat evaluate."""
    jobs: Annotated[int, flag("N", default="1")] = 1
    """Number of scenes trained at the same time. They share the CPU; job i uses GPU i."""
    device: Annotated[Literal["cpu", "cuda"] | None, flag("{cpu,cuda}", default="a GPU")] = None
    """Device for the training."""
    json: JsonFlag = False

    def run(self) -> int:
        """Returns the exit code: 2 if a scene could not be trained, otherwise 0."""
        if self.folder is None:
            raise UserError("benchmark needs a folder that contains the scenes")
        if self.output is None:
            raise UserError("benchmark needs a folder for the results; add -o OUT")
        from snowsplat.pipeline.benchmark.run import BenchmarkOptions, benchmark

        given = {"iterations": self.iterations, "max_gaussians": self.max_gaussians}
        options = BenchmarkOptions(
            self.suite,
            self.scenes,
            self.recipe,
            {name: value for name, value in given.items() if value is not None},
            self.resolution,
            self.lpips,
            self.jobs,
            self.device,
        )
        report = benchmark(
            self.folder, self.output, options, on_line=lambda line: print(line, flush=True)
        )
        self.report = report
        print(
            message(
                "\n{report}\n\n{output}: the results as a page",
                report=report,
                output=self.output / "index.html",
            )
        )
        return 2 if report.failures else 0
