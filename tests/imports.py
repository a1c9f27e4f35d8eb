"""Loads modules, for a process whose forks run commands or tests: see fork_server.py."""

import gc
import importlib
import io
from contextlib import redirect_stdout, suppress

_LIBRARIES = ("torch", "numpy", "PIL.Image", "hypothesis", "safetensors.torch", "zstandard", "rich")


def import_all() -> None:
    """Import what the subcommands import, and keep it out of garbage collections."""
    from PIL import Image

    import snowsplat.cli.main
    import snowsplat.evaluation.metrics
    import snowsplat.extras
    import snowsplat.formats
    import snowsplat.pipeline.make
    import snowsplat.pipeline.videos
    import snowsplat.scene.edit
    import snowsplat.sfm.colmap.reconstruct
    import snowsplat.sfm.make_dataset
    import snowsplat.sfm.orient
    import snowsplat.sfm.report.dataset_report
    import snowsplat.sfm.undistort
    import snowsplat.training.budgets.time_plan
    import snowsplat.training.core.checkpoint
    import snowsplat.training.core.trainer
    import snowsplat.training.report
    import snowsplat.training.settings.recipes
    import snowsplat.viewer.http.server
    import snowsplat.viewer.http.static
    import snowsplat.viewer.web.scene
    from snowsplat.util.errors import UserError

    snowsplat.extras.register()
    for name in snowsplat.cli.main.SUBCOMMANDS:
        with suppress(UserError):  # arguments are missing
            snowsplat.cli.main.parse([name])
    Image.init()  # imports the readers of all formats
    # Forks need not examine, and thereby copy, the objects that exist now.
    gc.collect()
    gc.freeze()


def import_libraries() -> None:
    """Import pytest and the libraries; not the package, which is another one in each fork."""
    import pytest

    for name in _LIBRARIES:
        importlib.import_module(name)
    with redirect_stdout(io.StringIO()):
        pytest.main(["--version"])  # imports its plugins
    gc.collect()
    gc.freeze()
