"""Estimates principal points: the pixel on the optical axis of each camera, with a prior.

The principal point of a lens is near the centre of the photo, but not in it. An error of it turns
all cameras and moves them, and is not seen in the reprojection errors. Where the photos determine
it, the estimate is better than the centre. Where they do not (few photos, a plane, a walk straight
ahead), it would be arbitrary. So it is the maximum a posteriori estimate of

    p ~ N(p₀, σ² I),   p₀: the centre of the photo,   σ: `SIGMA` times its longer side,

and of the observations. Bundle adjustment with free principal points gives the maximum likelihood
estimate p̂ and its covariance C, where the other parameters are free, too (a block of the inverse of
the Hessian; σ₀², the variance of an observation, comes from the residuals). Near p̂, the likelihood
is Gaussian, and with precision matrices Λ = C⁻¹ and Π = I / σ², the maximum of the product is

    p = (Λ + Π)⁻¹ (Λ p̂ + Π p₀).

The other parameters then are adjusted with p held.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence

import numpy as np
import pycolmap
from numpy.typing import NDArray

from snowsplat.sfm.colmap.lenses.lens import robust_adjustment, used_cameras

#: Standard deviation of a principal point from the centre of the photo, in each direction, divided
#: by the longer side. The lens on a sensor is off by about this.
SIGMA = 0.01
# The covariance is that of at most this number of photos, because its time grows with their cube:
# 1 s. More photos determine more, so it is too large rather than too small.
_MOST_PHOTOS = 200
_TOLERANCE = 1e-4  # of bundle adjustment, as in `robust_adjustment`
Floats = NDArray[np.float64]


def refine_principal_points(
    model: pycolmap.Reconstruction, threads: int
) -> pycolmap.Reconstruction:
    """A copy of ``model`` with the most likely principal points, after bundle adjustment.

    If bundle adjustment fails, or does not determine the parameters, this is ``model``. Its errors
    of points must be up to date.
    """
    numbers = [n for n in used_cameras(model) if len(model.cameras[n].principal_point_idxs()) == 2]
    if not numbers:
        return model
    made = copy.deepcopy(model)
    # pycolmap computes covariances only if all frames have poses, also those that are not part of
    # the model. Such a pose has no effect.
    without = [frame for frame in made.frames.values() if not frame.has_pose()]
    for frame in without:
        frame.rig_from_world = pycolmap.Rigid3d()
    scale = model.compute_mean_reprojection_error()
    images = sorted(model.reg_image_ids())
    adjuster = _adjuster(made, images, scale, threads, free=True)
    summary = adjuster.solve()
    if len(images) > _MOST_PHOTOS:
        some = np.linspace(0, len(images) - 1, _MOST_PHOTOS).round().astype(int)
        adjuster = _adjuster(made, [images[i] for i in some], scale, threads, free=True)
    covariances = _covariances(made, numbers, adjuster, summary)
    if covariances is None:
        return model
    for number, covariance in zip(numbers, covariances, strict=True):
        camera = made.cameras[number]
        params = camera.params.copy()
        rows = list(camera.principal_point_idxs())
        centre = np.array([camera.width, camera.height]) / 2
        sigma = SIGMA * max(camera.width, camera.height)
        params[rows] = combine_with_prior(params[rows], covariance, centre, sigma)
        camera.params = params
    for frame in without:
        frame.reset_pose()
    _adjuster(made, images, scale, threads, free=False).solve()
    made.update_point_3d_errors()
    return made


def combine_with_prior(
    estimate: Floats, covariance: Floats, centre: Floats, sigma: float
) -> Floats:
    """(2,) the maximum of the product of two Gaussians, in pixels.

    Args:
        estimate, covariance: (2,) and (2, 2), of the observations; infinite: they say nothing.
        centre, sigma: (2,) and the standard deviation in each direction, of the prior.
    """
    # Λ (Λ + Π)⁻¹ = Π⁻¹ (Λ⁻¹ + Π⁻¹)⁻¹: the gain of a Kalman filter, which has no inverse of C.
    if not np.isfinite(covariance).all():
        return centre
    gain = sigma**2 * np.linalg.inv(covariance + sigma**2 * np.eye(2))
    return centre + gain @ (estimate - centre)


def _adjuster(
    model: pycolmap.Reconstruction, images: Sequence[int], scale: float, threads: int, free: bool
) -> pycolmap.CeresBundleAdjuster:
    """Bundle adjustment of ``images``; ``free``: with principal points; ``scale`` of the loss in
    pixels."""
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in images:
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    options = robust_adjustment(threads, _TOLERANCE, scale)
    options.refine_principal_point = free
    return pycolmap.create_default_ceres_bundle_adjuster(options, config, model)


def _covariances(
    model: pycolmap.Reconstruction,
    numbers: Sequence[int],
    adjuster: pycolmap.CeresBundleAdjuster,
    summary: pycolmap.BundleAdjustmentSummary,
) -> list[Floats] | None:
    """(2, 2) of the principal point of each camera in pixels²; None: they are undetermined."""
    assert isinstance(summary, pycolmap.CeresBundleAdjustmentSummary)  # of a Ceres adjuster
    ceres = summary.ceres_summary
    freedom = ceres.num_residuals_reduced - ceres.num_effective_parameters_reduced
    if not summary.is_solution_usable() or freedom <= 0:
        return None
    options = pycolmap.BACovarianceOptions()
    options.params = pycolmap.BACovarianceOptionsParams.ALL
    found = pycolmap.estimate_ba_covariance(options, model, adjuster)
    if found is None:
        return None
    variance = 2 * ceres.final_cost / freedom
    covariances = []
    for number in numbers:
        camera = model.cameras[number]
        whole = found.get_other_params_cov(camera.params)
        if whole is None:  # none of the chosen photos has this camera
            covariances.append(np.full((2, 2), np.inf))
            continue
        if len(whole) != len(camera.params) or not np.isfinite(whole).all():
            return None
        rows = list(camera.principal_point_idxs())
        covariances.append(variance * whole[np.ix_(rows, rows)])
    return covariances
