"""The score of a model: how probable its cameras make all verified matches, in nats.

Attempts have other photos, poses and lenses, and points of their own, so they are compared by what
they have in common: the verified matches, also those that made no point. The score is the logarithm
of the posterior probability, up to a constant that is the same for all models of these photos:

    Σ_matches log(ε + (1 − ε) r(d)) + f² Σ_cameras log p(lens) − ½ k log n

Matches (MLESAC, Torr and Zisserman 2000). d is the Sampson distance of a match from the epipolar
line of the poses, in pixels; infinite if its rays meet behind a camera. A true match has
a normal error of standard deviation σ across the line; a false one is anywhere within the distance
D, half of the longer side. The ratio of the densities is

    r(d) = √(2/π) (D / σ) exp(−d² / 2σ²).

σ and the share ε of false matches are those that make the score of the model largest (expectation
maximisation), with σ of at least `LEAST_NOISE`. Matches of a photo without a pose may be of any
kind: they add nothing. So a photo that is left out costs what its matches would have said, and one
in a wrong place costs more: log ε for each match. All matches of a pair count: places that look
alike have fewer than photos that were taken side by side.

Lenses have the priors of `lenses.prior`. The matches count as if their errors were independent, but
they are not, so the priors count as often as the matches do: f is `OVERDISPERSION`.

Complexity. k is the number of parameters of the poses and lenses, n that of the matches of all
photos (Schwarz 1978).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap

from snowsplat.scene.epipolar import LEAST_FALSE, LEAST_NOISE, likelihood
from snowsplat.sfm.colmap.checks.matches import PairMatches
from snowsplat.sfm.colmap.lenses.lens import used_cameras
from snowsplat.sfm.colmap.lenses.posterior import OVERDISPERSION
from snowsplat.sfm.colmap.lenses.prior import log_prior


@dataclass(frozen=True)
class Score:
    """The parts of a score in nats, and what they were computed with."""

    matches: float
    lenses: float
    complexity: float  # not negative
    noise: float  # σ in pixels
    false: float  # ε
    explained: float  # share of all matches, also those of photos without a pose, that are true

    @property
    def total(self) -> float:
        """In nats."""
        return self.matches + self.lenses - self.complexity


def score_of(
    model: pycolmap.Reconstruction, pairs: Sequence[PairMatches], exif: Mapping[int, float]
) -> Score:
    """The score of the cameras of ``model``.

    Args:
        pairs: the matches of all photos, with the image ids of ``model``. Models can be compared if
            these are the same.
        exif: focal lengths in pixels, by the camera ids of ``model``.
    """
    placed = set(model.reg_image_ids())
    distances, sides = [], []
    for pair in pairs:
        if pair.first not in placed or pair.second not in placed:
            continue
        distance, side = pair.distances(model)
        distances.append(distance)
        sides.append(np.full(len(distance), side))
    cameras = used_cameras(model)
    count = 6 * len(placed) + sum(len(model.cameras[i].params) for i in cameras)
    everything = sum(len(pair.in_first) for pair in pairs)
    complexity = 0.5 * count * math.log(max(2, everything))
    prior = sum(log_prior(model.cameras[i], exif.get(i)) for i in cameras)
    lenses = OVERDISPERSION**2 * prior
    if not distances:
        return Score(0.0, lenses, complexity, LEAST_NOISE, LEAST_FALSE, 0.0)
    value, noise, false, true = likelihood(np.concatenate(distances), np.concatenate(sides))
    return Score(value, lenses, complexity, noise, false, true / everything)
