"""`snowsplat benchmark`: all scenes of a benchmark suite, and a table."""

from dataclasses import dataclass
from pathlib import Path

from snowsplat.cli.command import Exit, JsonCommand, print_message
from snowsplat.pipeline.options.benchmark import BenchmarkOptions
from snowsplat.util.settings import group, needed


@dataclass(frozen=True, kw_only=True)
class Benchmark(JsonCommand):
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

    folder: Path = needed(
        "benchmark needs a folder that contains the scenes",
        "FOLDER",
        "Contains one folder for each scene.",
        argument=True,
    )
    output: Path = needed(
        "benchmark needs a folder for the results; add -o OUT",
        "OUT",
        "A folder for the scenes and the tables.",
        "-o",
    )
    options: BenchmarkOptions = group(BenchmarkOptions)

    def run(self) -> Exit:
        """The exit code is 2 if a scene could not be trained."""
        from snowsplat.pipeline.benchmark.run import benchmark

        report = benchmark(self.folder, self.output, self.options, on_line=print_message)
        print_message(
            "\n{report}\n\n{output}: the results as a page",
            report=report,
            output=self.output / "index.html",
        )
        return Exit(2 if report.failures else 0, report)
