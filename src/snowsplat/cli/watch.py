"""`snowsplat watch`: the output folder of a training run in the browser, finished or running."""

from dataclasses import dataclass

from snowsplat.cli.command import Command
from snowsplat.cli.observer import WatchObserver
from snowsplat.cli.pages import PageAddress
from snowsplat.cli.scene_choice import SceneChoice
from snowsplat.util.settings import group


@dataclass(frozen=True, kw_only=True)
class Watch(Command):
    """Show an ongoing or finished training run in the browser, with its photos.

    Examples:
      snowsplat watch out/garden
      snowsplat watch out/garden --port 9000

    Notes:
      A training that is running on this computer shows its present state and can
      be paused, also without --view. Closing the page does not end it. Of one on
      another computer, in several processes, or on Windows, the page shows the
      newest scene or checkpoint that has been saved (see --checkpoint-every of
      snowsplat train). Ctrl-C closes the page.
    """

    scene: SceneChoice = group(SceneChoice)
    address: PageAddress = group(PageAddress)

    def run(self) -> None:
        """Runs until Ctrl-C."""
        path = self.scene.path()
        from snowsplat.pipeline.watch import watch

        page = self.address.page()
        assert page is not None
        with WatchObserver() as observer, page:
            watch(
                path,
                page,
                iteration=self.scene.iteration,
                dataset=self.scene.dataset,
                resolution=self.scene.resolution,
                compute=self.scene.compute,
                observer=observer,
            )
