"""`ViewGradient`: the gradient of the loss of one view with respect to its splats."""

from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor

from snowsplat import ops
from snowsplat.ops import SplatGradient, Splats2D, View
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.render import view_of


@dataclass(frozen=True)
class ViewGradient:
    """∂L/∂splats of one view: the input of density control and of the optimiser.

    When they run on a GPU, the CPU does not know yet whether the step is valid (see `StepRunner`).
    This information is in ``valid``, on the device. The two operations that change the state of the
    training read it there: `add_statistics` (density control) and `ops.adam_step` (`Adam`). An
    invalid step changes nothing, so their callers need not handle it.

    Attributes:
        splats: the splats from `scene.render.project`; the gradient is ``splats.packed.grad``.
            ``splats.abs_grad`` is not None if the density control requires it.
        camera: the camera of the view, at the resolution of the step. It is needed to propagate the
            gradient from the splats to the parameters of the Gaussians.
        sh_degree: degree of the spherical harmonics used by this step.
        valid: (1,) bool on the device; None is True.
        nonfinite_rows: (6,) int32 on the device, see `ops.adam_step`; None disables counting.
    """

    splats: Splats2D
    camera: Camera
    sh_degree: int
    valid: Tensor | None = None
    nonfinite_rows: Tensor | None = None

    @property
    def packed_grad(self) -> Tensor:
        """(M, 16): the gradient of ``splats.packed``."""
        assert self.splats.packed.grad is not None
        return self.splats.packed.grad

    @property
    def of_splats(self) -> SplatGradient:
        """The gradient of the splats as an argument of the operations."""
        return SplatGradient.of(self.splats)

    def view(self, gaussians: Gaussians) -> View:
        """The view that ``gaussians`` were projected to."""
        return view_of(gaussians, self.camera, self.sh_degree)

    def ignore(self, rows: Tensor) -> None:
        """Set the gradient of some Gaussians to zero, in place, also in ``splats.abs_grad``.

        Args:
            rows: (N,) bool, the Gaussians of this process.
        """
        assert self.splats.ids is not None
        ignored = rows[self.splats.ids.long(), None]
        self.packed_grad.masked_fill_(ignored, 0.0)
        if self.splats.abs_grad is not None:
            self.splats.abs_grad.masked_fill_(ignored, 0.0)

    def add_to(self, gaussians: Gaussians, grads: Mapping[str, Tensor]) -> None:
        """Add the gradient with respect to the parameters of the Gaussians to ``grads``."""
        ops.add_project_gradients(gaussians, grads, self.of_splats, self.view(gaussians))

    def add_statistics(
        self,
        norm_sum: Tensor,
        views: Tensor,
        max_radii: Tensor | None = None,
        *,
        absolute: bool = False,
    ) -> None:
        """Add this view to statistics of the Gaussians, by `ops.accumulate_screen_statistics`.

        For each visible Gaussian: norm_sum (N,) += |∂L/∂mean2d · (width/2, height/2)|,
        views (N,) += 1, and max_radii (N,) = max(max_radii, 3σ radius in pixels) unless it is None.
        If ``absolute``, ``splats.abs_grad`` replaces ∂L/∂mean2d.
        """
        ops.accumulate_screen_statistics(
            self.splats,
            self.camera.width,
            self.camera.height,
            norm_sum,
            views,
            max_radii,
            self.valid,
            absolute=absolute,
        )
