"""`snowsplat watch`: the output folder of a training run in the browser, finished or running."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from snowsplat.cli.flags import flag
from snowsplat.cli.observer import WatchObserver
from snowsplat.cli.page_flags import AllowHost, page_at
from snowsplat.cli.scene_flags import SceneFlags


@dataclass
class Watch(SceneFlags):
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

    port: Annotated[int | None, flag("N", default="8080, or the next free one")] = None
    """Port of the page. Its URL, which is printed, contains a secret token."""
    host: Annotated[str | None, flag("H", default="127.0.0.1, this computer only")] = None
    """Address to listen on. 0.0.0.0 accepts connections from the network."""
    allow_host: AllowHost = ()

    def run(self) -> int:
        """Runs until Ctrl-C; returns the exit code, 0."""
        path = self.output_path()
        from snowsplat.pipeline.watch import watch

        page = page_at(self.port, self.host, self.allow_host)
        assert page is not None
        with WatchObserver() as observer, page:
            watch(
                path,
                page,
                iteration=self.iteration,
                dataset=self.dataset,
                resolution=self.resolution,
                compute=self.compute(),
                observer=observer,
            )
        return 0
