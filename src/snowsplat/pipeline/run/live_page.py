"""`LivePage`: the page of the live viewer, for a training run or for its output folder."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

from snowsplat.data import Dataset
from snowsplat.pipeline.observer import SILENT, Observer
from snowsplat.scene.gaussians import Gaussians
from snowsplat.training.core.trainer import Trainer
from snowsplat.viewer.hosts import LOCAL_HOST, KnownHosts
from snowsplat.viewer.http.listen import listen

if TYPE_CHECKING:  # most trainings have no page; importing its server takes 0.1 s
    from snowsplat.viewer.live.training import TrainingViewer
    from snowsplat.viewer.live.viewer import NetworkViewer


class LivePage:
    """A page at ``port`` of this machine; as a context manager, it closes the page at the end.

        with LivePage() as page:
            train("garden", "out/garden", page=page)
            page.show_result()

    Attributes:
        viewer: the page while it is open.
        training: shows a training run there, if one has begun.
    """

    def __init__(
        self, port: int | None = None, host: str | None = None, allow_host: Sequence[str] = ()
    ) -> None:
        """
        Args:
            port: None: 8080, or the next free one.
            host: address at which to listen; None: accept connections from this machine only.
            allow_host: names of proxies; see `KnownHosts`.

        Raises: UserError: the port is in use, this machine cannot listen at ``host``, or an allowed
        name is none.
        """
        self.port, self.host, self.allow_host = port, host or LOCAL_HOST, allow_host
        KnownHosts(self.host, allow_host)
        self.viewer: NetworkViewer | None = None
        self.training: TrainingViewer | None = None
        self._trainer: Trainer | None = None
        listen(self.host, port).close()

    def __enter__(self) -> LivePage:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def open(
        self,
        dataset: Dataset,
        background: tuple[float, float, float],
        label: str,
        observer: Observer = SILENT,
    ) -> NetworkViewer:
        """Open the page, and report its address to the observer.

        ``background``: red, green, blue in 0..1. ``label``: the title of the page.
        Raises: UserError: another process has opened the port since the constructor checked it.
        """
        from snowsplat.viewer.live.viewer import NetworkViewer

        viewer = NetworkViewer(
            dataset,
            background,
            host=self.host,
            port=self.port,
            label=label,
            allow_host=self.allow_host,
        )
        self.viewer = viewer
        observer.page_opened(viewer)
        return viewer

    def open_training(
        self, trainer: Trainer, label: str, observer: Observer = SILENT
    ) -> TrainingViewer:
        """Open the page for a training run, as `open`; call `after_step` of the returned object."""
        from snowsplat.viewer.live.curves import SampledPsnr
        from snowsplat.viewer.live.training import TrainingViewer

        white = trainer.config.background == "white"
        background = (1.0, 1.0, 1.0) if white else (0.0, 0.0, 0.0)
        viewer = self.open(trainer.dataset, background, label, observer)
        views = trainer.dataset.test or trainer.dataset.train
        self.training = TrainingViewer(viewer, SampledPsnr(views, viewer.background))
        self._trainer = trainer
        return self.training

    @property
    def url(self) -> str:
        assert self.viewer is not None
        return self.viewer.url

    def show_result(self, gaussians: Gaussians | None = None) -> None:
        """Show a scene until Ctrl-C: by default, that of the finished training run."""
        assert self.training is not None
        assert self._trainer is not None
        with suppress(KeyboardInterrupt):
            shown = self._trainer.gaussians if gaussians is None else gaussians
            self.training.show(self._trainer.step, shown)

    def close(self) -> None:
        """Close the page if it is open, and release the trainer."""
        viewer, self.viewer = self.viewer, None
        self.training = self._trainer = None
        if viewer is not None:
            viewer.close()
