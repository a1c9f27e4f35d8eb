"""`snowsplat evaluate`: how near a scene is to its photos."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from snowsplat.cli.flags import flag
from snowsplat.cli.scene import SceneFlags
from snowsplat.util.errors import UserError

if TYPE_CHECKING:
    from snowsplat.evaluation.metrics import ViewMetrics


@dataclass
class Evaluate(SceneFlags):
    """Measure a scene on the photos that were held out: PSNR, SSIM and, with weights, LPIPS.

    Examples:
      snowsplat evaluate out/garden
      snowsplat evaluate out/garden --split train
      snowsplat evaluate out/garden --lpips lpips_vgg.safetensors

    The figures of each view and their means are printed, and written to OUT/metrics.json. Renders
    are clamped to 0..1 and not rounded to 8 bits. The weights file for LPIPS is made once, where
    the package lpips is installed, by
      weights = {name: w.clone() for name, w in lpips.LPIPS(net="vgg").state_dict().items()}
      safetensors.torch.save_file(weights, "lpips_vgg.safetensors")
    """

    split: Annotated[Literal["test", "train"], flag("{test,train}", default="test")] = "test"
    """The photos held out, or those trained on."""
    lpips: Annotated[Path | None, flag("FILE", default="not measured")] = None
    """Weights for LPIPS: of AlexNet or VGG16 and of the linear heads, safetensors or torch."""

    def run(self) -> int:
        """Gives the exit code, 0."""
        iteration, gaussians, dataset, background = self.load()
        views = dataset.test if self.split == "test" else dataset.train
        if not views:
            raise UserError(
                "no photos were held out for testing; train with --eval, or use --split train"
            )
        from snowsplat.evaluation.lpips import Lpips
        from snowsplat.evaluation.metrics import evaluate_views
        from snowsplat.util.process import single_threaded

        network = None if self.lpips is None else Lpips.load(self.lpips)
        width = max(4, *(len(view.name) for view in views))
        heading = "LPIPS" if network is None else f"LPIPS ({network.name})"
        print(f"{'view':{width}}   PSNR    SSIM   {heading}")

        def show(figures: ViewMetrics) -> None:
            lpips = "-" if figures.lpips is None else f"{figures.lpips:.4f}"
            print(f"{figures.name:{width}}  {figures.psnr:6.3f}  {figures.ssim:.4f}  {lpips}")

        with single_threaded():  # so that the figures do not depend on the machine's cores
            evaluation = evaluate_views(
                gaussians, views, background=background, lpips=network, on_view=show
            )
        lpips = "-" if evaluation.lpips is None else f"{evaluation.lpips:.4f}"
        print(f"{'mean':{width}}  {evaluation.psnr:6.3f}  {evaluation.ssim:.4f}  {lpips}")
        if network is None:
            print("LPIPS was not measured: it needs a weights file, see --help")
        folder = self.folder()
        folder.write_metrics(iteration, self.split, evaluation)
        where = folder.path / "metrics.json"
        print(f"iteration {iteration}, {len(views)} {self.split} views: {where}")
        return 0
