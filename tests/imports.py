"""Loads all modules of the command line, for a process whose forks run it."""

import gc
from contextlib import suppress


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
