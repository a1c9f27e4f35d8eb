"""The flags `--view`, `--port` and `--host`, and the page that they ask for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from snowsplat.util.errors import UserError

if TYPE_CHECKING:
    from snowsplat.data import Dataset
    from snowsplat.training.trainer import Trainer
    from snowsplat.viewer.live.training import TrainingViewer
    from snowsplat.viewer.live.viewer import NetworkViewer

LOCAL = "127.0.0.1"


@dataclass(frozen=True)
class PageFlags:
    """Where a page is to be."""

    port: int | None = None
    host: str | None = None

    def check(self, view: bool) -> None:
        """Before anything is begun.

        Raises:
            UserError: a place for a page that nobody wants, or one that cannot be had.
        """
        if view:
            from snowsplat.viewer.live.server import free_port

            free_port(self.host or LOCAL, self.port)
            return
        for name, value in (("--port", self.port), ("--host", self.host)):
            if value is not None:
                raise UserError(f"{name} says where a page is to be; add --view to have one")

    def open(
        self, dataset: Dataset, background: tuple[float, float, float], label: str
    ) -> NetworkViewer:
        """Open the page, and say where it is.

        Raises:
            UserError: the port is taken, or the host is not this machine.
        """
        from snowsplat.viewer.live.viewer import NetworkViewer

        host = self.host or LOCAL
        viewer = NetworkViewer(dataset, background, host=host, port=self.port, label=label)
        print(f"watch it in a browser: {viewer.url}", flush=True)
        if viewer.others is not None:
            print(f"from other computers: {viewer.others}", flush=True)
        if host == LOCAL:
            port = viewer.url.rpartition(":")[2]
            print(f"from another computer: ssh -L {port}:localhost:{port} THIS_ONE", flush=True)
        return viewer

    def open_for(self, trainer: Trainer, label: str) -> TrainingViewer:
        """The page of a training."""
        from snowsplat.viewer.live.gauge import Gauge
        from snowsplat.viewer.live.training import TrainingViewer

        white = trainer.config.background == "white"
        background = (1.0, 1.0, 1.0) if white else (0.0, 0.0, 0.0)
        viewer = self.open(trainer.dataset, background, label)
        views = trainer.dataset.test or trainer.dataset.train
        return TrainingViewer(viewer, Gauge(views, viewer.background))
