"""Extreme input of `plane_sweep` by hypothesis, and its check against the float64 reference."""

import math

import torch
from hypothesis import strategies as st

from snowsplat.ops import reference

from .scenes import Variant, as_float32, generator, normal, uniform

#: What is wrong with a source; hypothesis shrinks to the first, an ordinary one.
KINDS = ("plain", "behind", "at camera", "far", "infinite", "NaN", "flat", "holes")


def sweeps() -> st.SearchStrategy[tuple[int, tuple[int, int], tuple[str, ...], int, int, bool]]:
    """seed, size, a kind for each source, radius, planes, and whether there are centres."""
    return st.tuples(
        st.integers(0, 2**20),
        st.sampled_from(((23, 17), (1, 1), (1, 40), (40, 1), (33, 9))),
        st.lists(st.sampled_from(KINDS), min_size=1, max_size=8).map(tuple),
        st.integers(1, 7),
        st.integers(2, 6),
        st.booleans(),
    )


def check_plane_sweep(
    variant: Variant, drawn: tuple[int, tuple[int, int], tuple[str, ...], int, int, bool]
) -> None:
    """Results are in their ranges, and the score is that of the reference.

    In float32, rounding decides for a few windows whether a source sees them.
    """
    seed, (width, height), kinds, radius, planes, centres = drawn
    g = generator(seed)
    count = len(kinds)
    image = uniform(g, 0, 1, height, width)
    sources = uniform(g, 0, 1, count, height + 3, width + 2)
    matrix = torch.eye(3, 4, dtype=torch.float64).repeat(count, 1, 1)
    matrix[:, :2] += 0.3 * normal(g, count, 2, 4)
    matrix[:, 2, 3] = 0.1 * normal(g, count)
    for i, kind in enumerate(kinds):
        if kind == "behind":
            matrix[i] *= -1
        elif kind == "at camera":
            matrix[i] = 0
        elif kind == "far":
            matrix[i, :2] *= 1e30
        elif kind == "infinite":
            matrix[i, i % 3, i % 4] = math.inf
        elif kind == "NaN":
            matrix[i, i % 3, i % 4] = math.nan
        elif kind == "flat":
            sources[i] = 0.25
        elif kind == "holes":
            sources[i, :: 5 + i % 4] = math.nan
    matrix = as_float32(matrix)
    centre = uniform(g, -0.5, 1, height, width) if centres else None
    ranges = {"planes": planes, "radius": radius}
    expected = reference.plane_sweep(image, sources, matrix, 0.0, 1.0, **ranges, centre=centre)
    tensors = [tensor.to(variant.dtype) for tensor in (image, sources, matrix)]
    centre = None if centre is None else centre.to(variant.dtype)
    depth, score = variant.ops.plane_sweep(*tensors, 0.0, 1.0, **ranges, centre=centre)
    assert depth.isfinite().all()
    assert score.isfinite().all()
    assert score.min() >= -1
    assert score.max() <= 1
    assert (depth[score == -1] == 0).all()
    wrong = (score.double() - expected[1]).abs() > variant.forward
    if variant.dtype == torch.float64:
        assert not wrong.any()
    else:
        assert wrong.double().mean() < 0.05
