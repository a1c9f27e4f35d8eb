"""`PoseRefinement`: the cameras of the training views are optimised together with the scene.

The pose of a view is a motion η (6,) in pixels after its first pose; see `pose_coordinates`. The
gradient g of the loss with respect to the camera, from `ops.camera_gradient`, becomes that of η. An
update is a damped Newton step with momentum and an upper limit. For a mean absolute difference of
colours, the second derivative by a shift is about E / b, with the mean square E of the derivative
of the photo and the mean b of the differences; b is taken as constant:

    η ← η − clamp(momentum of (GAIN / E) g, ± limit)

One factor of the focal lengths of each camera is optimised in the same way, once in each epoch.

The photos cannot determine a common similarity transform of all cameras, so the scene could drift
away from the held-out views. After each update, the part of all η that is such a transform is
subtracted; see `pose_coordinates.Gauge`.

Cameras would move a little even if they are exact, because the scene is not. So before the first
update, the photos are compared with the scene (`misalignment`). If their shift is small, no camera
moves, and the training is that without refinement, to the bit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from snowsplat.data.dataset import View
from snowsplat.ops import camera_gradient
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.training.parts.misalignment import shift_of
from snowsplat.training.parts.part import Part, PartReport
from snowsplat.training.parts.pose_coordinates import Gauge, after_motion, pixel_hessian, whitening
from snowsplat.training.step.batch import Batch, Gradients
from snowsplat.training.step.view_gradient import ViewGradient
from snowsplat.util.messages import Message, message

if TYPE_CHECKING:
    from snowsplat.training.core.run import Run

#: The first fraction of the steps, in which the scene is still too blurred to move cameras.
BEGIN = 0.2
#: The poses are exact if the median shift of the photos is then below this share of the diagonal.
EXACT = 0.002
#: An estimate of the mean difference of colours of a rendering and its photo.
GAIN = 0.05
MOMENTUM = 0.6
#: The upper limit of the first and of the last update of each component, in units of the diagonal
#: of the image. It decreases exponentially.
FIRST_LIMIT, LAST_LIMIT = 1e-3, 2e-4
#: A lower limit of E, for photos of one colour.
_LEAST_ENERGY = 1e-6


class PoseRefinement(Part):
    """The cameras of the training views. Each process computes the same cameras."""

    name = "poses"

    def __init__(self) -> None:
        self._energies: dict[tuple[int, int], float] = {}  # of `_energy`

    def prepare(self, run: Run) -> None:
        """Replace the cameras of the run; at first, they are the same."""
        run.cameras = self
        self._dataset = dataset = run.dataset
        self._first = cameras = run.dataset_cameras
        device = cameras[0].cam_from_world.device
        keys = [_intrinsics(camera) for camera in cameras]
        self._groups = {key: i for i, key in enumerate(dict.fromkeys(keys))}
        self._group = [self._groups[key] for key in keys]
        hessians = [pixel_hessian(camera, dataset) for camera in cameras]
        units = [whitening(hessian[:6, :6]) for hessian in hessians]
        self._units = torch.stack(units).to(device)  # (V, 6, 6): P
        self._gauge = Gauge(cameras, self._units, dataset.extent)
        # Pixels for each change of the logarithm of the focal length, in the root mean square.
        of_focal = torch.stack([hessian[6, 6].sqrt() for hessian in hessians])
        group = torch.tensor(self._group)
        of_groups = [of_focal[group == i].mean() for i in range(len(self._groups))]
        self._focal_units = torch.stack(of_groups).to(device)
        self._diagonal = max(math.hypot(camera.width, camera.height) for camera in cameras)
        views, groups = len(cameras), len(self._groups)
        shapes: dict[str, tuple[int, ...]] = {
            "motions": (views, 6),
            "motions.momentum": (views, 6),
            "motions.updates": (views, 1),
            "focals": (groups,),
            "focals.momentum": (groups,),
            "focals.updates": (groups,),
            "focals.sum": (groups,),  # of the steps of this epoch
            "exact": (1,),  # 0: not decided yet; 1: the poses are exact; -1: they are not
        }
        self._state = {
            name: torch.zeros(shape, dtype=torch.float64, device=device)
            for name, shape in shapes.items()
        }
        self._factors = [1.0] * groups  # of the focal lengths
        self._exact = 0.0  # as in the state

    def camera(self, view: int) -> Camera:
        """The present camera of a training view."""
        first = self._first[view]
        motion = self._units[view] @ self._state["motions"][view]
        factor = self._factors[self._group[view]]
        pose = after_motion(first.cam_from_world, motion)
        return replace(first, cam_from_world=pose, fx=factor * first.fx, fy=factor * first.fy)

    def views(self) -> list[View]:
        """The training views with their present cameras, on the CPU."""
        cpu = torch.device("cpu")
        return [
            replace(view, camera=self.camera(i).to(cpu))
            for i, view in enumerate(self._dataset.train)
        ]

    def test_views(self) -> list[View]:
        """The test views. Their poses do not change; their focal lengths do, with the camera."""
        return [replace(view, camera=self._with_focal(view.camera)) for view in self._dataset.test]

    def _with_focal(self, camera: Camera) -> Camera:
        group = self._groups.get(_intrinsics(camera))
        factor = 1.0 if group is None else self._factors[group]
        return replace(camera, fx=factor * camera.fx, fy=factor * camera.fy)

    def between(self, run: Run) -> None:
        """Decide once, after the first part of the training, whether the poses are exact.

        Raises: UserError: a photo is missing or damaged.
        """
        if self._exact != 0.0 or run.step < run.schedule.step_of(BEGIN):
            return
        background = run.background.evaluation.tolist()
        shift = shift_of(run.gaussians, self.views(), background, run.render, run.sh_degree)
        self._state["exact"].fill_(1.0 if shift < EXACT else -1.0)
        self._read_state()

    def gradients(self, run: Run, step: int, batch: Batch, gradients: Gradients) -> None:
        """Move the cameras of a batch, before the Gaussians are updated."""
        if self._exact >= 0.0:
            return
        done = (run.schedule.share(step) - BEGIN) / (1.0 - BEGIN)
        limit = self._diagonal * FIRST_LIMIT * (LAST_LIMIT / FIRST_LIMIT) ** done
        for view, gradient in zip([each.index for each in batch], gradients, strict=True):
            d_motion, d_focal = self._gradient(run, view, gradient)
            downscale = round(self._first[view].width / gradient.camera.width)
            # The loss of a batch is the mean over its views.
            gain = GAIN * len(batch) / self._energy(run, view, downscale)
            self._update("motions", view, gain * (d_motion @ self._units[view]), limit, gradient)
            self._state["focals.sum"][self._group[view]] += gain * d_focal
        motions = self._state["motions"]
        motions -= self._gauge.part(motions)
        if run.schedule.multiples(step, len(self._first)):
            self._update_focals(limit)

    def _energy(self, run: Run, view: int, downscale: int) -> float:
        """The mean square of the derivative of a reduced photo by a shift of one original pixel."""
        key = view, downscale
        if key not in self._energies:
            photo = run.images.get(self._dataset.train[view], downscale)
            planes = photo.planes[:3].float() / 255.0
            squares = [planes.diff(dim=axis).square().mean() for axis in (1, 2)]
            mean = 0.5 * float(squares[0] + squares[1]) if min(planes.shape) > 1 else 0.0
            self._energies[key] = max(mean, _LEAST_ENERGY) / downscale**2
        return self._energies[key]

    def _gradient(self, run: Run, view: int, gradient: ViewGradient) -> tuple[Tensor, Tensor]:
        """(6,) with respect to (ω, τ), to first order, and () with respect to log f; finite."""
        camera = gradient.camera

        def over_processes(sums: Tensor) -> Tensor:
            return run.shards.table(sums).sum(0)

        d_pose, d_focal = camera_gradient(
            run.gaussians,
            gradient.of_splats,
            gradient.view(run.gaussians),
            over_processes=over_processes if run.shards.size > 1 else None,
        )
        motion = self._units[view] @ self._state["motions"][view]
        turned = camera.cam_from_world.double() - torch.nn.functional.pad(motion[3:, None], (3, 0))
        # A rotation by dω changes [R | t] by [dω]× [R | t]: the gradient is the axial vector of
        # the antisymmetric part.
        product = d_pose @ turned.T
        d_rotation = torch.stack(
            [
                product[2, 1] - product[1, 2],
                product[0, 2] - product[2, 0],
                product[1, 0] - product[0, 1],
            ]
        )
        d_motion = torch.cat([d_rotation, d_pose[:, 3]])
        if gradient.valid is not None:
            d_focal = torch.where(gradient.valid[0], d_focal, 0.0)
        return d_motion.nan_to_num(0.0, 0.0, 0.0), d_focal.nan_to_num(0.0, 0.0, 0.0)

    def _update(
        self, name: str, row: int, step: Tensor, limit: float, gradient: ViewGradient | None = None
    ) -> None:
        """Update a row of a parameter; not if the gradient is from a step that is not valid."""
        keys = (name, f"{name}.momentum", f"{name}.updates")
        value, momentum, updates = (self._state[key][row] for key in keys)
        updates = updates + 1.0
        momentum = MOMENTUM * momentum + (1.0 - MOMENTUM) * step
        value = value - (momentum / (1.0 - MOMENTUM**updates)).clamp(-limit, limit)
        for key, new in zip(keys, (value, momentum, updates), strict=True):
            if gradient is not None and gradient.valid is not None:
                new = torch.where(gradient.valid[0], new, self._state[key][row])
            self._state[key][row] = new

    def _update_focals(self, limit: float) -> None:
        sums = self._state["focals.sum"]
        for group in range(len(self._factors)):
            mean = sums[group] / (self._group.count(group) * self._focal_units[group])
            self._update("focals", group, mean, limit)
        sums.zero_()
        self._read_state()

    def _read_state(self) -> None:
        self._factors = (self._state["focals"] / self._focal_units).exp().tolist()
        self._exact = float(self._state["exact"])

    def drift(self) -> PoseDrift:
        """How far the cameras have moved."""
        cpu = torch.device("cpu")
        motions = torch.einsum("vij,vj->vi", self._units, self._state["motions"]).to(cpu)
        factors = torch.tensor(self._factors, dtype=torch.float64)
        return PoseDrift(
            exact=self._exact > 0.0,
            rotations=torch.rad2deg(motions[:, :3].norm(dim=1)),
            translations=motions[:, 3:].norm(dim=1) / self._dataset.extent,
            focals=factors - 1.0,
        )

    def report(self, run: Run, gaussians: Gaussians) -> PartReport:
        """The line about the poses. Refined poses are no fault of the scene."""
        return PartReport(lines=(self.drift().line,))

    def state(self) -> dict[str, Tensor]:
        """The state of the cameras and of their optimiser."""
        return self._state

    def load(self, tensors: dict[str, Tensor]) -> None:
        """See `Part.load`."""
        for name, tensor in self._state.items():
            tensor.copy_(tensors[name])
        self._read_state()


@dataclass(frozen=True)
class PoseDrift:
    """How far refined cameras are from the first ones.

    Attributes:
        exact: whether the first cameras were found to be exact, and left unchanged.
        rotations: (V,) degrees.
        translations: (V,) as shares of the extent of the scene.
        focals: (C,) relative change of the focal length of each camera.
    """

    exact: bool
    rotations: Tensor
    translations: Tensor
    focals: Tensor

    @property
    def line(self) -> Message:
        """What the user is told."""
        if self.exact:
            return message("the photos agree with the camera poses, which are left unchanged")
        turn, shift = self.rotations, 100.0 * self.translations
        return message(
            "camera poses refined: rotation by {turn:.2f}° in the median, at most "
            "{turn_most:.2f}°; position by {shift:.2f}% of the extent, at most {shift_most:.2f}%; "
            "focal length by {focal:+.2f}%",
            turn=float(turn.median()),
            turn_most=float(turn.max()),
            shift=float(shift.median()),
            shift_most=float(shift.max()),
            focal=100.0 * float(self.focals[self.focals.abs().argmax()]),
        )


def _intrinsics(camera: Camera) -> tuple[float, ...]:
    """Views with equal intrinsics are from the same camera."""
    return camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy
