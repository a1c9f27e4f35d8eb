"""Extreme scenes by hypothesis, and checks of the ops on each against the float64 reference.

If the result of the reference changes a lot when its input changes by a few roundings, the exact
result is undefined. The tolerance of each number is therefore a multiple of one rounding error,
plus the change of the reference for such changes of its input.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any
from unittest import mock

import torch
from hypothesis import strategies as st
from torch import Tensor

from snowsplat.ops import AdamRates, Splats2D, reference

from .extreme_sweeps import check_plane_sweep, sweeps
from .scenes import (
    PARAMETERS,
    Scene,
    Variant,
    as_float32,
    generator,
    normal,
    take_step,
    tilted_pose,
    uniform,
    view_of,
    world_points,
)

#: Values of a Gaussian, drawn independently; hypothesis shrinks to the first, an ordinary value.
PLACES = (
    *("plain", "same depth", "same place", "behind", "at camera", "around camera", "at near"),
    *("just in front", "just behind", "far", "farther", "beside", "on axis", "border"),
)
SCALES = ("plain", "1e-12", "1e12", "any", "needle", "disc", "1e34", "1e-34", "pixel")
QUATS = ("plain", "zero", "1e-30", "1e15", "axis")
OPACITIES = ("plain", "100", "-100", "faint", "edge", "half")
COLORS = ("plain", "1e6", "1e20", "-100", "0")
SIZES = ((23, 17), (1, 1), (1, 40), (40, 1), (16, 16), (33, 9))
FOCALS = (1.0, 1e-6, 1e-2, 1e3, 1e6)  # times the size of the image

#: Limit for values whose squares and products are representable in single precision.
LARGE = 1e9
#: Squares of larger gradients overflow, so these are skipped.
_LARGEST_GRADIENT = {torch.float32: 1e18, torch.float64: 1e150}


@dataclass(frozen=True)
class Extreme:
    """The parameters of a scene; everything else is derived from the seed."""

    seed: int
    size: tuple[int, int]
    focal: float
    degree: int
    gaussians: tuple[tuple[str, str, str, str, str], ...]

    def scene(self) -> Scene:
        g = generator(self.seed)
        width, height = self.size
        pose = tilted_pose()
        view = view_of(pose, width, height, self.focal * max(width, height), self.degree)
        kinds = list(zip(*self.gaussians, strict=True)) or [()] * 5
        count = len(self.gaussians)
        plain = uniform(g, 1.0, 6.0, count)
        x = (uniform(g, -0.2, 1.2, count) * width - view.cx) / view.fx
        y = (uniform(g, -0.2, 1.2, count) * height - view.cy) / view.fy
        in_camera = torch.stack([x, y, torch.ones(count)], dim=1) * plain[:, None]
        means = world_points(pose, _placed(kinds[0], in_camera, g))
        scales = _scales(kinds[1], math.log(2.0 / view.fx) + plain.log(), g)
        quats = normal(g, count, 4)
        factors = {"zero": 0.0, "1e-30": 1e-30, "1e15": 1e15}
        for i, kind in enumerate(kinds[2]):
            quats[i] *= factors.get(kind, 1.0)
            if kind == "axis":
                quats[i] = torch.tensor([0.0, 0.0, -1.0, 0.0])
        logits = 1.8 * normal(g, count)
        edge = math.log(1 / 254)  # the visibility threshold
        special = {"100": 100.0, "-100": -100.0, "faint": edge - 0.01, "edge": edge, "half": 0.0}
        for i, kind in enumerate(kinds[3]):
            logits[i] = special.get(kind, logits[i])
        dc, rest = 0.8 * normal(g, count, 1, 3), 0.3 * normal(g, count, 15, 3)
        for i, kind in enumerate(kinds[4]):
            factor = {"1e6": 1e6, "1e20": 1e20, "0": 0.0}.get(kind, 1.0)
            dc[i], rest[i] = dc[i] * factor, rest[i] * factor
            if kind == "-100":
                dc[i] = -100.0
        values = (means, scales, quats, logits, dc, rest)
        params = {n: as_float32(v) for n, v in zip(PARAMETERS, values, strict=True)}
        return Scene(params, view)


def extremes(most: int = 6) -> st.SearchStrategy[Extreme]:
    gaussian = st.tuples(*(st.sampled_from(k) for k in (PLACES, SCALES, QUATS, OPACITIES, COLORS)))
    return st.builds(
        Extreme,
        seed=st.integers(0, 2**20),
        size=st.sampled_from(SIZES),
        focal=st.sampled_from(FOCALS),
        degree=st.sampled_from((3, 0, 1, 2)),
        gaussians=st.lists(gaussian, max_size=most).map(tuple),
    )


def _placed(kinds: Sequence[str], plain: Tensor, g: torch.Generator) -> Tensor:
    places = plain.clone()
    for i, kind in enumerate(kinds):
        noise = normal(g, 3)
        across = torch.tensor([0.0, 0.0, 1.0]).double()
        places[i] = {
            "same depth": torch.cat([plain[i, :2], torch.tensor([2.5]).double()]),
            "same place": torch.tensor([0.1, 0.05, 2.5]).double(),
            "behind": -plain[i],
            "at camera": 0 * noise,
            "around camera": 0.3 * noise,
            "at near": torch.cat([0.05 * noise[:2], torch.tensor([0.2]).double()]),
            "just in front": 1e-6 * across,
            "just behind": -1e-6 * across + 1e-3 * noise * (1 - across),
            "far": 1e6 * plain[i],
            "farther": 1e12 * plain[i],
            "beside": plain[i] + 1e5 * (1 - across) * noise.sign(),
            "on axis": plain[i] * across,
            "border": plain[i] + noise * (1 - across) * 10,
        }.get(kind, plain[i])
    return places


def _scales(kinds: Sequence[str], pixels: Tensor, g: torch.Generator) -> Tensor:
    scales = pixels[:, None] + 0.6 * normal(g, len(pixels), 3)
    log = math.log(10.0)
    for i, kind in enumerate(kinds):
        if kind in ("1e-12", "1e12", "1e34", "1e-34"):
            scales[i] = log * float(kind[2:])
        if kind == "any":
            scales[i] = uniform(g, -12 * log, 12 * log, 3)
        if kind in ("needle", "disc"):
            thin = torch.tensor([kind == "needle", True, False])
            scales[i] = torch.where(thin, scales[i] - 8.0, scales[i] + 2.0)
        if kind == "pixel":
            scales[i] = pixels[i]
    return scales


# ------------------------------------------------------------------------------------ comparisons


@dataclass(frozen=True)
class Compared:
    """The reference's results, and how far each number moves if its input changes by roundings.

    Most results agree without this spread, which takes six calls of the reference: it is computed
    when a comparison needs it.
    """

    value: Tensor
    spread: Callable[[], Tensor]

    @staticmethod
    def of(
        function: Callable[..., Sequence[Tensor]], variant: Variant, seed: int, *inputs: Tensor
    ) -> list[Compared]:
        """``function``: maps float64 inputs to several results."""
        rounding = 1e-5 if variant.dtype == torch.float32 else 1e-10
        values = function(*inputs)

        @functools.cache
        def spreads() -> list[Tensor]:
            found = [torch.zeros_like(value) for value in values]
            g = generator(seed)
            for _ in range(3):
                changes = [
                    rounding * (2 * torch.rand(t.shape, generator=g).double() - 1) for t in inputs
                ]
                for sign in (1.0, -1.0):  # so that values at a threshold fall on both sides
                    moved = [t * (1 + sign * c) for t, c in zip(inputs, changes, strict=True)]
                    for spread, value, other in zip(found, values, function(*moved), strict=True):
                        # NaN: not compared.
                        torch.maximum(spread, (other - value).abs(), out=spread)
            return found

        return [
            Compared(v, functools.partial(lambda k: spreads()[k], i)) for i, v in enumerate(values)
        ]

    def at(self, rows: Tensor) -> Compared:
        return Compared(self.value[rows], lambda: self.spread()[rows])

    def in_rows(self) -> Compared:
        """Use the spread of a row for each of its numbers: few input changes affect all."""
        return Compared(self.value, lambda: _of_rows(self.spread()))

    def check(
        self, actual: Tensor, relative: float, name: str, scale: Tensor | None = None
    ) -> None:
        """``scale``: magnitude of the summands of a number if they may cancel."""
        assert actual.shape == self.value.shape, f"{name}: {actual.shape}, not {self.value.shape}"
        scale = self.value.abs() if scale is None else scale
        fault = self._fault(actual, relative, scale, relative * scale)
        if fault:
            fault = self._fault(actual, relative, scale, relative * scale + 10.0 * self.spread())
        assert not fault, f"{name}: {fault}"

    def _fault(self, actual: Tensor, relative: float, scale: Tensor, tolerance: Tensor) -> str:
        decided = tolerance.isfinite() & (scale < 1e30) & (self.value.abs() < 1e30)
        found = actual.detach().double()[decided]
        if not found.isfinite().all():
            return "not finite where the reference is"
        excess = (found - self.value[decided]).abs() - tolerance[decided] - 1e-4 * relative
        worst = float(excess.max()) if len(excess) else 0.0
        return f"off by {worst:.3g} more than {tolerance[decided].max():.3g}" if worst > 0 else ""


def _every_row(scene: Scene, params: Sequence[Tensor], pose: Tensor) -> tuple[Tensor, Tensor]:
    """(N, 16) the reference's row of each Gaussian, NaN if not visible; and which are visible."""
    splats = scene.of_leaves(*params, pose).project(reference)
    assert splats.ids is not None
    rows = torch.full((len(params[0]), splats.packed.shape[1]), torch.nan, dtype=torch.float64)
    rows = rows.index_copy(0, splats.ids.long(), splats.packed)
    return rows, rows[:, 0].isfinite()


def _of_rows(values: Tensor) -> Tensor:
    """The sum of absolute values over each row, in the shape of ``values``."""
    return values.abs().sum(tuple(range(1, values.ndim)), keepdim=True).expand_as(values)


# ----------------------------------------------------------------------------- what must hold


def check_project(variant: Variant, extreme: Extreme) -> None:
    """Ids are right where visibility is clear; splats and gradients agree with the reference."""
    scene = extreme.scene()
    count = len(extreme.gaussians)
    leaf = scene.to(variant.dtype)
    splats = leaf.project(variant.ops)
    assert splats.ids is not None
    ids = splats.ids.long()
    assert ids.tolist() == sorted({i for i in ids.tolist() if 0 <= i < count})
    assert splats.packed.isfinite().all(), "a splat is not finite"

    params = [scene.params[name] for name in PARAMETERS]
    cotangent = normal(generator(extreme.seed + 1), count, 16)

    def by_reference(*inputs: Tensor) -> list[Tensor]:
        leaves = [t.detach().requires_grad_() for t in inputs]
        rows, seen = _every_row(scene, leaves[:6], leaves[6])
        grads = torch.autograd.grad(
            torch.where(seen[:, None], rows, 0.0), leaves[:6], cotangent, allow_unused=True
        )
        grads = [
            torch.zeros_like(t) if d is None else d for t, d in zip(leaves, grads, strict=False)
        ]
        return [rows.detach(), seen.double(), *grads]

    rows, seen, *grads = Compared.of(
        by_reference, variant, extreme.seed, *params, scene.cam_from_world
    )
    # In single precision, the determinant of the largest overflows, so they are invisible.
    huge = (rows.value[:, 7] > 3 * LARGE) & (variant.dtype == torch.float32)
    edge = (255 * scene.params["opacity_logits"].sigmoid() - 1).abs() < 1e-5
    clear = ~huge & ~edge
    found = torch.zeros(count, dtype=torch.bool)
    found[ids] = True
    if not torch.equal(found[clear], seen.value.bool()[clear]):
        clear &= seen.spread() == 0
    assert torch.equal(found[clear], seen.value.bool()[clear]), "who is seen"

    both = clear & found
    packed = torch.zeros(count, 16, dtype=variant.dtype)
    packed[ids] = splats.packed.detach()
    scale = rows.value.abs()
    scale[:, 3] = (scale[:, 2] * scale[:, 4]).sqrt()  # b of a conic is at most √(a c)
    scale[:, 8:11] += scene.params["sh_dc"].abs().sum(1) + scene.params["sh_rest"].abs().sum(1)
    rows.at(both).check(packed[both], 3 * variant.forward, "packed", scale[both])

    splats.packed.backward(cotangent.to(variant.dtype)[ids])
    for name, wanted in zip(PARAMETERS, grads, strict=True):
        grad = leaf.params[name].grad
        assert grad is not None
        assert grad.isfinite().all(), f"the gradient of {name} is not finite"
        seen_rows = wanted.at(both).in_rows()
        scale = _of_rows(seen_rows.value)
        if name == "quats":  # the effect of a rotation cancels if the scales are equal
            parts = grads[PARAMETERS.index("log_scales")].at(both).value.abs().sum(1, keepdim=True)
            scale = scale + parts / params[2][both].norm(dim=1, keepdim=True).clamp_min(1e-30)
        seen_rows.check(grad[both], 10 * variant.backward, f"gradient of {name}", scale)
        assert not grad[~found].any(), f"a gradient of {name} where nothing is seen"
    check_adam(variant, leaf, ids, cotangent)


def check_adam(variant: Variant, leaf: Scene, ids: Tensor, cotangent: Tensor) -> None:
    """The gradients in the fused step, visible in the first moments, are those of `project`."""
    params = {name: p.detach().clone() for name, p in leaf.params.items()}
    m, v = ({name: torch.zeros_like(p) for name, p in params.items()} for _ in range(2))
    nonfinite_rows = torch.zeros(6, dtype=torch.int32)
    take_step(
        variant.ops,
        replace(leaf, params=params),
        m,
        v,
        ids.to(torch.int32),
        cotangent.to(variant.dtype)[ids],
        AdamRates(dict.fromkeys(PARAMETERS, 1e-3), 1),
        nonfinite_rows=nonfinite_rows,
    )
    for i, name in enumerate(PARAMETERS):
        grad = leaf.params[name].grad
        assert grad is not None
        for tensor in (params[name], m[name], v[name]):
            assert tensor.isfinite().all(), f"{name} is not finite after a step"
        large = grad.abs() > _LARGEST_GRADIENT[variant.dtype]
        too_large = int(large.nonzero()[:, 0].unique().numel())
        skipped = int(nonfinite_rows[i])
        assert skipped <= too_large, f"{skipped} rows of {name} skipped, {too_large} have a reason"
        error = (m[name] - 0.1 * grad).abs() - variant.backward * _of_rows(grad)
        # Kernels flush denormal numbers to zero.
        assert (error[~large] <= torch.finfo(variant.dtype).tiny).all(), f"the moment of {name}"


def check_rasterize(variant: Variant, extreme: Extreme) -> None:
    """Image, alpha, depth and the gradient of the splats of a projected scene."""
    splats = extreme.scene().to(variant.dtype, requires_grad=False).project(variant.ops)
    width, height = extreme.size
    g = generator(extreme.seed + 2)
    background = uniform(g, 0.0, 1.0, 3)
    cotangents = [normal(g, height, width, 3), normal(g, height, width), normal(g, height, width)]
    a, b, c = splats.conics.double().unbind(dim=1)
    # If splats are thousands of times as long as wide, a rounded conic is not positive definite.
    fit = a * c - b * b > 3 * a * c * torch.finfo(variant.dtype).eps
    assert splats.ids is not None
    splats = Splats2D(splats.packed[fit], splats.ids[fit], 3)
    packed = splats.packed.detach().double()

    def blended(module: Any, values: Tensor) -> list[Tensor]:
        leaf = values.detach().requires_grad_()
        outputs = module.rasterize(
            Splats2D(leaf, None, 3), width, height, background.to(leaf), with_depth=True
        )
        weights = [c.to(leaf) for c in cotangents]
        grad = torch.zeros_like(leaf)
        if len(leaf):
            torch.autograd.backward(outputs, weights)
            assert leaf.grad is not None
            grad = leaf.grad
        return [*(output.detach() for output in outputs), grad]

    # Two splats of the maximum opacity leave a transmittance of 1e-4, the limit of a pixel.
    ends = itertools.cycle(
        reference.TRANSMITTANCE_MIN * (1 + change) for change in (0, 1e-6, -1e-6)
    )

    def by_reference(values: Tensor) -> list[Tensor]:
        values = values.clone()
        values[:, 6] = packed[:, 6]  # equal depths stay equal
        with mock.patch.object(reference, "TRANSMITTANCE_MIN", next(ends)):
            return blended(reference, values)

    found = blended(variant.ops, packed.to(variant.dtype))
    wanted = Compared.of(by_reference, variant, extreme.seed, packed)
    names = ("image", "alpha", "depth", "gradient of the splats")
    factors = [variant.forward] * 3 + [10 * variant.backward]
    if len(packed):  # the colour behind a splat is computed as a difference
        factors[3] *= max(1.0, float(packed[:, 6:11].max()))
    for w, f, name, factor in zip(wanted, found, names, factors, strict=True):
        w.check(f, factor, name, None if name != "alpha" else torch.ones_like(w.value))
    assert found[1].min() >= 0
    assert found[1].max() <= 1
    check_statistics(variant, extreme, splats, found[3])


def check_statistics(variant: Variant, extreme: Extreme, splats: Splats2D, grad: Tensor) -> None:
    count = len(extreme.gaussians)
    sums = []
    for module, dtype in ((variant.ops, variant.dtype), (reference, torch.float64)):
        leaf = Splats2D(splats.packed.detach().to(dtype).requires_grad_(), splats.ids, 3)
        leaf.packed.grad = grad.to(dtype)
        sums.append(torch.zeros(3, count, dtype=dtype))
        module.accumulate_screen_statistics(leaf, *extreme.size, *sums[-1])
    assert sums[0].isfinite().all()
    counted = sums[0][1].bool()
    assert (sums[1][0][~counted] > _LARGEST_GRADIENT[variant.dtype]).sum() == (
        sums[1][1] - sums[0][1]
    ).sum()
    torch.testing.assert_close(
        sums[0].double()[:, counted], sums[1][:, counted], rtol=1e-5, atol=1e-30
    )


def check_harm(variant: Variant, extreme: Extreme, value: float, picks: Sequence[int]) -> None:
    """Non-finite Gaussians do not change the others' bits; ``picks``: Gaussians, parameters."""
    results = []
    count = len(extreme.gaussians)
    healthy = torch.ones(count, dtype=torch.bool)
    for broken in (False, True):
        scene = extreme.scene()
        for i, pick in enumerate(picks[:count]):
            if pick == 0:
                continue
            healthy[i] = False
            if broken:
                row = scene.params[PARAMETERS[pick - 1]][i]
                row.view(-1)[extreme.seed % row.numel()] = value
        leaf = scene.to(variant.dtype)
        splats = leaf.project(variant.ops)
        assert splats.ids is not None
        ids = splats.ids.long()
        assert ids.tolist() == sorted({i for i in ids.tolist() if 0 <= i < count})
        cotangent = normal(generator(extreme.seed + 3), count, 16).to(variant.dtype)[ids]
        splats.packed.backward(cotangent)
        state = leaf.to(variant.dtype, requires_grad=False)
        m, v = ({n: torch.zeros_like(p) for n, p in state.params.items()} for _ in range(2))
        rates = AdamRates(dict.fromkeys(m, 1e-3), 1)
        take_step(variant.ops, state, m, v, splats.ids, cotangent, rates)
        for name, tensor in (*m.items(), *v.items()):
            assert tensor.isfinite().all(), f"a moment of {name}"
        rows = {f"{n} after": t for n, t in state.params.items()}
        rows |= {f"m of {n}": t for n, t in m.items()}
        rows |= {f"gradient of {n}": p.grad for n, p in leaf.params.items() if p.grad is not None}
        seen = {"ids": ids[healthy[ids]], "packed": splats.packed.detach()[healthy[ids]]}
        results.append(seen | {n: t[healthy] for n, t in rows.items()})
        # The result is not checked; the call only has to terminate.
        drawn = Splats2D(splats.packed.detach().requires_grad_(), splats.ids, 3)
        image, _, _ = variant.ops.rasterize(drawn, *extreme.size, with_depth=True)
        image.sum().backward()
    for name, wanted in results[0].items():
        assert torch.equal(results[1][name], wanted), name


def photos() -> st.SearchStrategy[tuple[int, tuple[int, int], str, bool]]:
    """seed, size, kind, whether the photo has 8-bit values."""
    sizes = [(7, 5), (1, 1), (1, 60), (60, 1), (11, 11), (33, 34)]
    kinds = ["noise", "black", "white", "equal", "negative", "1e6", "1e-20"]
    return st.tuples(
        st.integers(0, 2**20), st.sampled_from(sizes), st.sampled_from(kinds), st.booleans()
    )


def check_photometric(
    variant: Variant, photo: tuple[int, tuple[int, int], str, bool], weight: float
) -> None:
    seed, (width, height), kind, of_bytes = photo
    g = generator(seed)
    image = uniform(g, 0.0, 1.0, 3, height, width)
    photo_planes = torch.randint(0, 256, (3, height, width), generator=g, dtype=torch.uint8)
    flat = {"black": 0.0, "white": 1.0, "1e-20": 1e-20}
    if kind in flat:
        image[:] = flat[kind]
    elif kind == "equal":
        image = as_float32(photo_planes.double() / 255)
    elif kind == "negative":
        image -= 1.0
    elif kind == "1e6":
        image *= 1e6
    target = photo_planes if of_bytes else as_float32(photo_planes.double() / 255)
    found = []
    for module, dtype in ((variant.ops, variant.dtype), (reference, torch.float64)):
        leaf = image.to(dtype).permute(1, 2, 0).requires_grad_()
        other = (target if of_bytes else target.to(dtype)).permute(1, 2, 0)
        loss = module.photometric_loss(leaf, other, weight)
        loss.backward()
        assert leaf.grad is not None
        found.append((loss.detach().double(), leaf.grad.double()))
    (loss, grad), (wanted_loss, wanted_grad) = found
    assert loss.isfinite()
    assert grad.isfinite().all()
    # Variances are differences of squares, which single precision cannot represent for 1e6. And the
    # slope of |a − b| is undefined where they are equal.
    if kind == "1e6" and variant.dtype == torch.float32:
        return
    assert abs(float(loss - wanted_loss)) <= 10 * variant.forward * max(1.0, float(wanted_loss))
    if kind != "equal":
        error = (grad - wanted_grad).norm() / wanted_grad.norm().clamp_min(1e-30)
        assert error <= 3 * variant.backward, f"gradient: {float(error):.2g}"


def clouds() -> st.SearchStrategy[tuple[int, int, int, tuple[str, ...]]]:
    """seed, k, dimensions of the cloud, and a kind for each point."""
    kinds = st.sampled_from(("plain", "same", "1e-12", "1e12", "1e17", "near", "plane"))
    return st.tuples(
        st.integers(0, 2**20),
        st.integers(1, 8),
        st.integers(1, 3),
        st.lists(kinds, max_size=40).map(tuple),
    )


def check_neighbours(variant: Variant, cloud: tuple[int, int, int, tuple[str, ...]]) -> None:
    seed, k, dimensions, kinds = cloud
    g = generator(seed)
    points = normal(g, len(kinds), 3)
    points[:, dimensions:] = 0.25
    for i, kind in enumerate(kinds):
        if kind in ("1e-12", "1e12", "1e17"):
            points[i] *= float(kind)
        elif kind == "same":
            points[i] = 0.5
        elif kind == "near":
            points[i] = as_float32(1.0 + 1e-6 * points[i])
        elif kind == "plane":
            points[i] = points[i].round()
    points = as_float32(points)
    found = variant.ops.neighbours(points.to(variant.dtype), k).double()
    wanted = reference.neighbours(points, k)
    assert torch.equal(found.isinf(), wanted.isinf())
    some = wanted.isfinite()
    torch.testing.assert_close(found[some], wanted[some], rtol=1e-5, atol=1e-19)


#: The strategies of each check, and the check.
CHECKS: dict[str, tuple[tuple[st.SearchStrategy, ...], Callable[..., None]]] = {
    "project": ((extremes(),), check_project),
    "rasterize": ((extremes(),), check_rasterize),
    "harm": (
        (
            extremes(),
            st.sampled_from((math.nan, math.inf, -math.inf)),
            st.lists(st.integers(0, len(PARAMETERS)), min_size=6, max_size=6),
        ),
        check_harm,
    ),
    "neighbours": ((clouds(),), check_neighbours),
    "plane sweep": ((sweeps(),), check_plane_sweep),
    "photometric": ((photos(), st.sampled_from((0.2, 0.0, 1.0))), check_photometric),
}
