"""`LivePage`: the page of the live viewer, for a training run or for its output folder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
    from snowsplat.viewer.live.viewer import NetworkViewer, Scene


class LivePage:
    """A page at ``port`` of this machine; as a context manager, it closes the page at the end.

    with LivePage() as page:
        train("garden", "out/garden", page=page)
        page.show_result()
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
        self._viewer: NetworkViewer | None = None
        self._training: TrainingViewer | None = None
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
        self._viewer = viewer
        observer.page_opened(viewer)
        return viewer

    def open_training(self, trainer: Trainer, label: str, observer: Observer = SILENT) -> None:
        """Open the page for a training run, as `open`; then call `after_step` after each step."""
        from snowsplat.viewer.live.curves import SampledPsnr
        from snowsplat.viewer.live.training import TrainingViewer

        white = trainer.config.background == "white"
        background = (1.0, 1.0, 1.0) if white else (0.0, 0.0, 0.0)
        viewer = self.open(trainer.dataset, background, label, observer)
        views = trainer.dataset.test or trainer.dataset.train
        self._training = TrainingViewer(viewer, SampledPsnr(views, viewer.background))
        self._trainer = trainer

    def after_step(self, step: int, steps: int, loss: float, gaussians: Gaussians) -> float:
        """Update the page after a step, and wait while a user has paused the training.

        Returns the seconds for which the training was paused; see `TrainingViewer.after_step`.
        """
        assert self._training is not None
        return self._training.after_step(step, steps, loss, gaussians)

    @property
    def url(self) -> str:
        assert self._viewer is not None
        return self._viewer.url

    @property
    def others(self) -> list[str]:
        """The addresses for other computers, if they differ."""
        assert self._viewer is not None
        return self._viewer.others

    def resume(self) -> None:
        """Resume the training if a user has paused it; may be called in any thread."""
        if (viewer := self._viewer) is not None:
            viewer.session.resume()

    def end_training(self, about: list[str]) -> None:
        """Show lines of text about the finished training run."""
        assert self._training is not None
        self._training.end(about)

    @property
    def has_trained(self) -> bool:
        """Whether the page shows a training run."""
        return self._training is not None

    def show_result(self, gaussians: Gaussians | None = None) -> None:
        """Show a scene until Ctrl-C: by default, that of the finished training run."""
        assert self._training is not None
        assert self._trainer is not None
        with suppress(KeyboardInterrupt):
            shown = self._trainer.gaussians if gaussians is None else gaussians
            self._training.show(self._trainer.step, shown)

    def show(self, scene: Callable[[], Scene]) -> None:
        """Show the newest scene until Ctrl-C. ``scene`` returns it, and is called repeatedly."""
        assert self._viewer is not None
        with suppress(KeyboardInterrupt):
            self._viewer.show_newest(scene)

    def close(self) -> None:
        """Close the page if it is open, and release the trainer."""
        viewer, self._viewer = self._viewer, None
        self._training = self._trainer = None
        if viewer is not None:
            viewer.close()
