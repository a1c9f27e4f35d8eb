"""Estimates lenses with a prior: the maximum a posteriori estimate of their parameters.

The principal point of a lens is near the centre of the photo, but not in it. An error of it turns
all cameras and moves them, and is not seen in the reprojection errors. Where the photos determine
it, the estimate is better than the centre. Where they do not (few photos, a plane, a walk straight
ahead), it would be arbitrary, and so would distortions, which no lens has then. `prior` knows what
lenses people use.

Bundle adjustment of all parameters gives the maximum likelihood estimate p̂ of those of a camera and
their covariance C, where the other parameters are free, too (a block of the inverse of the Hessian;
σ₀², the variance of an observation, comes from the residuals). This formal covariance is that of
independent errors. But lens models are not exact, so the errors of a photo are alike, and the true
errors are larger by `OVERDISPERSION`. Near p̂, the likelihood is Gaussian, and with the precision
matrices Λ of the observations and Π of the prior about p₀, the maximum of the product is

    p = (Λ + Π)⁻¹ (Λ p̂ + Π p₀).

The other parameters then are adjusted with p held.
"""

import copy
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import pycolmap

from snowsplat.sfm.colmap.lenses.lens import TOLERANCE, robust_adjustment, used_cameras
from snowsplat.sfm.colmap.lenses.prior import Floats, Term, log_prior, parameters, terms

#: Standard deviation of the error of a parameter, divided by the formal one. Measured: 3 to 9 from
#: measured cameras of two façades. Of estimates without an eighth of the photos each (jackknife):
#: 1.4 in a ray-traced room, whose lens the model describes exactly, 2 to 13 in eight captures.
OVERDISPERSION = 10.0
# The covariance is that of at most this number of photos, because its time grows with their cube:
# 1 s. More photos determine more, so it is too large rather than too small.
_MOST_PHOTOS = 200
_PHOTOS_OF_CAMERA = 2  # least mean number


def estimate_lenses(
    model: pycolmap.Reconstruction, exif: Mapping[int, float], certain: bool, threads: int
) -> pycolmap.Reconstruction:
    """A copy of ``model`` with the most probable lenses, after bundle adjustment.

    If bundle adjustment fails, does not determine the parameters, or ends with an impossible lens,
    or if there are nearly as many cameras as photos, this is ``model``. Its errors of points must
    be up to date.

    Args:
        exif: focal lengths in pixels, by camera id.
        certain: as in `terms`. If the photos tell less about them, this is ``model``.
    """
    numbers = [n for n in used_cameras(model) if not model.cameras[n].is_spherical()]
    images = sorted(model.reg_image_ids(), key=lambda i: (model.image(i).camera_id, i))
    # With a lens for each photo, the covariances between lenses would be needed, too: without them,
    # the error of fountain-P11 is 22 mm instead of 4. With a lens for two photos, it is 3 mm.
    if not 0 < _PHOTOS_OF_CAMERA * len(numbers) <= len(images):
        return model
    made = copy.deepcopy(model)
    # pycolmap computes covariances only if all frames have poses, also those that are not part of
    # the model. Such a pose has no effect.
    without = [frame for frame in made.frames.values() if not frame.has_pose()]
    for frame in without:
        frame.rig_from_world = pycolmap.Rigid3d()
    scale = model.compute_mean_reprojection_error()
    adjuster = _adjuster(made, images, scale, threads, free=True)
    summary = adjuster.solve()
    if len(images) > _MOST_PHOTOS:
        some = np.linspace(0, len(images) - 1, _MOST_PHOTOS).round().astype(int)
        adjuster = _adjuster(made, [images[i] for i in some], scale, threads, free=True)
    covariances = _covariances(made, numbers, adjuster, summary)
    if not covariances:
        return model
    for number, covariance in covariances.items():
        camera = made.cameras[number]
        known = list(terms(camera, exif.get(number), certain))
        if certain and known[0].variance(covariance) > known[0].usual ** 2:
            return model
        found = combine_with_prior(parameters(camera), covariance, known)
        focals = list(camera.focal_length_idxs())
        found[focals] = np.exp(found[focals])
        camera.params = list(found)
        if log_prior(camera, None) == -np.inf:
            return model
    for frame in without:
        frame.reset_pose()
    _adjuster(made, images, scale, threads, free=False).solve()
    made.update_point_3d_errors()
    return made


def combine_with_prior(estimate: Floats, covariance: Floats, known: Iterable[Term]) -> Floats:
    """(k,) the maximum of the product of two Gaussians.

    ``estimate``, ``covariance``: (k,) and (k, k), of the observations.
    """
    size = len(estimate)
    precision, pull = np.zeros((size, size)), np.zeros(size)
    for term in known:
        weighted = term.factors / term.deviation(estimate, covariance) ** 2
        precision += np.outer(term.factors, weighted)
        pull += (term.mean - term.factors @ estimate) * weighted
    # (Λ + Π)⁻¹ Π (p₀ − p̂) = (1 + C Π)⁻¹ C Π (p₀ − p̂), which has no inverse of C.
    step = np.linalg.solve(np.eye(size) + covariance @ precision, covariance @ pull)
    return np.asarray(estimate + step)


def _adjuster(
    model: pycolmap.Reconstruction, images: Sequence[int], scale: float, threads: int, free: bool
) -> pycolmap.CeresBundleAdjuster:
    """Bundle adjustment, ``free``: also of the lenses; ``scale`` of the loss in pixels."""
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in images:
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    options = robust_adjustment(threads, TOLERANCE, scale)
    options.refine_focal_length = free
    options.refine_principal_point = free
    options.refine_extra_params = free
    return pycolmap.create_default_ceres_bundle_adjuster(options, config, model)


def _covariances(
    model: pycolmap.Reconstruction,
    numbers: Sequence[int],
    adjuster: pycolmap.CeresBundleAdjuster,
    summary: pycolmap.BundleAdjustmentSummary,
) -> dict[int, Floats]:
    """(k, k) of the `parameters` of each camera of the photos, by its id; none: undetermined."""
    assert isinstance(summary, pycolmap.CeresBundleAdjustmentSummary)  # of a Ceres adjuster
    ceres = summary.ceres_summary
    freedom = ceres.num_residuals_reduced - ceres.num_effective_parameters_reduced
    if not summary.is_solution_usable() or freedom <= 0:
        return {}
    options = pycolmap.BACovarianceOptions()
    options.params = pycolmap.BACovarianceOptionsParams.ALL
    found = pycolmap.estimate_ba_covariance(options, model, adjuster)
    if found is None:
        return {}
    variance = OVERDISPERSION**2 * 2 * ceres.final_cost / freedom
    made = {}
    for number in numbers:
        params = model.cameras[number].params
        formal = found.get_other_params_cov(params)
        if formal is None:  # none of the photos has this camera
            continue
        if len(formal) != len(params) or not np.isfinite(formal).all():
            return {}
        slope = np.ones(len(params))  # of the parameters with logarithms
        focals = list(model.cameras[number].focal_length_idxs())
        slope[focals] = 1 / params[focals]
        made[number] = variance * formal * np.outer(slope, slope)
    return made
