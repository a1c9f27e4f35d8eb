"""`snowsplat evaluate`: how close a scene is to its photos."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from snowsplat.cli.command import JsonCommand, next_step, print_message
from snowsplat.cli.scene_choice import SceneChoice
from snowsplat.util.messages import message
from snowsplat.util.settings import flag, group, setting

if TYPE_CHECKING:
    from snowsplat.evaluation.metrics import Evaluation, ViewMetrics


@dataclass(frozen=True, kw_only=True)
class Evaluate(JsonCommand):
    """Compare a scene with the held-out photos: PSNR, SSIM and, with weights, LPIPS.

    Examples:
      snowsplat evaluate out/garden
      snowsplat evaluate out/garden --split train
      snowsplat evaluate out/garden --lpips vgg
      snowsplat evaluate splat.ply --dataset garden

    Notes:
      The metrics of each view and their means are printed, and written to
      OUT/metrics.json. The values of renders are clamped to 0..1, but not rounded
      to 8 bits. "aligned" is the PSNR after a gain and an offset of each channel of
      the render were fitted to the photo, so that exposure and white balance of the
      photo do not count. The photos have the size of the training, which
      a time limit may have reduced; -r 1: their own size.
      The weights of LPIPS are those of the package lpips (pip install lpips), which
      downloads a network once. For a computer without it, this writes a file:
      python -m snowsplat.evaluation.lpips vgg lpips_vgg.safetensors
    """

    scene: SceneChoice = group(SceneChoice)
    split: Literal["test", "train"] = flag(
        "test", "test: the held-out photos; train: the training photos."
    )
    lpips: Path | None = setting(
        None,
        "Measure LPIPS with this network, or with the weights in a safetensors file (of AlexNet or "
        "VGG16, and of the linear layers).",
        "not measured",
        metavar="{vgg,alex,FILE}",
    )
    model_paths: tuple[Path, ...] = setting(
        (), "Several output folders, one after the other.", metavar="OUT [OUT ...]"
    )

    def run(self) -> Any:
        several = [replace(self.scene, model_path=path) for path in self.model_paths]
        return [self._evaluate(each) for each in several] or self._evaluate(self.scene)

    def _evaluate(self, chosen: SceneChoice) -> dict[str, Any]:
        """Print the figures of one folder; returns them."""
        from snowsplat.evaluation.lpips import Lpips
        from snowsplat.pipeline.render import evaluate, views_of

        scene = chosen.load()
        views = views_of(scene, self.split)
        network = None if self.lpips is None else Lpips.load(self.lpips)
        width = max(4, *(len(view.name) for view in views))
        heading = "LPIPS" if network is None else f"LPIPS ({network.name})"
        print(f"{'view':{width}}   PSNR    SSIM  aligned  {heading}")

        def show(figures: ViewMetrics | Evaluation, name: str) -> None:
            aligned = f"{figures.psnr_aligned:6.3f}"
            lpips = "-" if figures.lpips is None else f"{figures.lpips:.4f}"
            print(f"{name:{width}}  {figures.psnr:6.3f}  {figures.ssim:.4f}   {aligned}  {lpips}")

        evaluation = evaluate(
            scene,
            split=self.split,
            lpips=network,
            on_view=lambda figures: show(figures, figures.name),
        )
        show(evaluation, "mean")
        if network is None:
            print_message("LPIPS was not measured; to measure it: --lpips vgg")
        where = scene.folder.metrics
        which = message(
            "{count} {split} views of {size}: {where}",
            count=len(evaluation.views),
            split=self.split,
            size=evaluation.size,
            where=where,
        )
        if scene.iteration:  # a file has none
            which = message("iteration {step}, {which}", step=scene.iteration, which=which)
        print(which)
        if evaluation.unjudged:
            print(evaluation.line_of_unjudged())
        out = chosen.path()
        photos = [] if chosen.dataset is None else ["--dataset", chosen.dataset]
        print(
            next_step(message("to see the renders"), "render", out, *photos, "--split", self.split)
        )
        about = {"folder": out, "iteration": scene.iteration, "split": self.split}
        return about | {"size": evaluation.size, **evaluation.as_json()}
