"""What is known about a lens before any photo was compared: the prior of its parameters.

The parameters are those of COLMAP, with logarithms of focal lengths (`parameters`). `terms` has
what is known, each as a linear combination of them. It has a normal distribution, that of the
lenses and photos that people use. But EXIF may be that of another photo, a photo may be cropped,
and a video stretched: with the probability `_UNUSUAL`, the distribution is a wider one (a mixture
of two normal distributions). So what the photos clearly contradict has no effect.

Distortions are expressed at the corner of the photo, at the distance ρ from its centre in units of
the focal length, as shares of this distance: k₁ ρ², k₂ ρ⁴, and p ρ for the tangential coefficients,
which come from a lens that is not exactly centred.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from snowsplat.sfm.colmap.lenses.lens import (
    GUESSED_FISHEYE,
    GUESSED_FOCAL,
    POLYNOMIAL,
    barrel,
    is_fisheye,
)

Floats = NDArray[np.float64]
_UNUSUAL = 0.05
# Standard deviations: the usual one, and the wider one.
# Of the logarithm of a focal length: by EXIF, which rounds it to a millimetre, and of all that
# people use: two thirds of photos are taken at 16 to 45 mm.
_EXIF = 0.05, 0.5
_FOCAL = 0.5, 0.5
# Of the logarithm of fx / fy: the pixels of sensors are square.
_SQUARE = 0.0005, 0.3
# Of the principal point from the centre of the photo, in each direction, divided by the longer
# side: the lens on a sensor is off by about this.
_CENTRE = 0.01, 0.2
# Of k₁ ρ², k₂ ρ⁴, p₁ ρ and p₂ ρ; of k₁ ρ² to k₄ ρ⁸ of a fisheye lens, where ρ is about the angle.
_ORDINARY = (2, (0.1, 0.3)), (4, (0.03, 0.3)), (1, (0.0005, 0.01)), (1, (0.0005, 0.01))
_FISHEYE = tuple((power, (0.1, 0.5)) for power in (2, 4, 6, 8))
_DISTORTIONS = dict.fromkeys(POLYNOMIAL, _ORDINARY) | dict.fromkeys(
    ("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE"), _FISHEYE
)


@dataclass(frozen=True)
class Term:
    """A linear combination of the `parameters` of a camera, and its distribution."""

    factors: Floats  # (k,)
    mean: float
    usual: float  # standard deviation
    wide: float  # standard deviation of what is not usual

    def log_density(self, params: Floats) -> float:
        """The logarithm of the density, relative to that of the mean if it is usual."""
        away = float(self.factors @ params) - self.mean
        return float(np.logaddexp(*self._both(away, 0.0)))

    def deviation(self, params: Floats, covariance: Floats) -> float:
        """The standard deviation of the more probable of the two distributions, if ``params`` (k,)
        were estimated with the errors ``covariance`` (k, k)."""
        away = float(self.factors @ params) - self.mean
        usual, wide = self._both(away, self.variance(covariance))
        return self.usual if usual >= wide else self.wide

    def variance(self, covariance: Floats) -> float:
        """That of the combination, for parameters with the ``covariance`` (k, k)."""
        return float(self.factors @ covariance @ self.factors)

    def _both(self, away: float, variance: float) -> tuple[float, float]:
        def log_density(share: float, deviation: float) -> float:
            total = math.hypot(deviation, math.sqrt(variance))
            return math.log(share * self.usual / total) - 0.5 * (away / total) ** 2

        return log_density(1 - _UNUSUAL, self.usual), log_density(_UNUSUAL, self.wide)


def parameters(camera: pycolmap.Camera) -> Floats:
    """(k,) the parameters of ``camera``, with logarithms of focal lengths."""
    made, focals = np.array(camera.params, float), list(camera.focal_length_idxs())
    made[focals] = np.log(made[focals])
    return made


def terms(camera: pycolmap.Camera, exif: float | None, certain: bool = False) -> Iterator[Term]:
    """What is known about the `parameters` of ``camera``.

    ``exif``: its focal length in pixels, if EXIF has it; ``certain``: it is that of this photo.
    """
    size = np.array([camera.width, camera.height], float)

    def term(factors: Mapping[int, float], mean: float, sigmas: tuple[float, float]) -> Term:
        row = np.zeros(len(camera.params))
        row[list(factors)] = list(factors.values())
        return Term(row, mean, *sigmas)

    focals = list(camera.focal_length_idxs())
    guess = GUESSED_FISHEYE if is_fisheye(camera.model_name) else GUESSED_FOCAL
    mean = math.log(exif or guess * size.max())
    sigmas = (_EXIF[0], _EXIF[not certain]) if exif else _FOCAL
    yield term(dict.fromkeys(focals, 1 / len(focals)), mean, sigmas)
    if len(focals) == 2:
        yield term({focals[0]: 1.0, focals[1]: -1.0}, 0.0, _SQUARE)
    for i, half in zip(camera.principal_point_idxs(), size / 2, strict=True):
        yield term({i: 1 / size.max()}, half / size.max(), _CENTRE)
    known = _DISTORTIONS.get(camera.model_name, ())
    corner = float(np.hypot(*size)) / (2 * camera.mean_focal_length())
    for i, (power, sigmas) in zip(camera.extra_params_idxs(), known, strict=False):
        yield term({i: corner**power}, 0.0, sigmas)


def log_prior(camera: pycolmap.Camera, exif: float | None) -> float:
    """The logarithm of the prior of a lens, relative to that of the most probable one; −∞ if it is
    no lens. ``exif`` as in `terms`."""
    if camera.is_spherical():
        return 0.0
    if not math.isfinite(barrel(camera)):  # it is not one-to-one over the whole photo
        return -math.inf
    return sum(term.log_density(parameters(camera)) for term in terms(camera, exif))
