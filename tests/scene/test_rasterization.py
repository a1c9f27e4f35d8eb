"""`rasterization` has the semantics of `gsplat.rasterization`; the float64 reference."""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from torch import Tensor

import snowsplat
from snowsplat import UserError, rasterization
from snowsplat.ops import Splats2D, View, reference, scratch
from snowsplat.ops.native import LAUNCHERS
from snowsplat.scene import rasterization as module

from ..ops.engines import launcher
from ..ops.scenes import assert_close, generator, normal, one_line, uniform

WIDTH, HEIGHT = 30, 20
MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")


@dataclass
class Inputs:
    """The tensors of a call: 40 Gaussians, and two cameras that see some of them."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    viewmats: Tensor
    Ks: Tensor
    backgrounds: Tensor

    def of(self, dtype: torch.dtype) -> Inputs:
        """Leaves of another dtype."""
        return Inputs(**{n: t.detach().to(dtype, copy=True) for n, t in vars(self).items()})

    def requiring_grad(self) -> Inputs:
        for name, tensor in vars(self).items():
            tensor.requires_grad_(name != "Ks")
        return self

    def rendered(self, **options: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
        return rasterization(**vars(self), width=WIDTH, height=HEIGHT, **options)

    def grads(self) -> dict[str, Tensor]:
        found = {n: t.grad for n, t in vars(self).items()}
        return {n: grad for n, grad in found.items() if grad is not None}


def inputs(kind: str = "RGB", count: int = 40) -> Inputs:
    """kind: "RGB", "SH" or a number of features; "per camera" for colours of each camera."""
    g = generator(3)
    z = uniform(g, 1.5, 6.0, count)
    x, y = (uniform(g, -0.7, 0.7, count) * z * side / 40 for side in (WIDTH, HEIGHT))
    z[::7] *= -1
    shape: tuple[int, ...] = (count, 16, 3) if "SH" in kind else (count, 3)
    if kind.isdigit():
        shape = (count, int(kind))
    if "per camera" in kind:
        shape = (2, *shape)
    first = torch.eye(4, dtype=torch.float64)
    second = first.clone()
    second[:3, :3] = reference._rotation_matrices(torch.tensor([[1.0, 0.05, -0.1, 0.2]]).double())[
        0
    ]
    second[:3, 3] = torch.tensor([0.2, -0.1, 0.5])
    K = torch.tensor([[40.0, 0, 15.5], [0, 44, 9.5], [0, 0, 1]], dtype=torch.float64)
    channels = shape[-1]
    return Inputs(
        means=torch.stack([x, y, z], dim=1),
        quats=normal(g, count, 4),
        scales=uniform(g, 0.05, 0.4, count, 3),
        opacities=uniform(g, 0.1, 0.95, count),
        colors=0.4 * normal(g, *shape),
        viewmats=torch.stack([first, second]),
        Ks=torch.stack([K, K * torch.tensor([[1.1], [0.9], [1.0]])]),
        backgrounds=uniform(g, 0, 1, 2, channels),
    )


def expected(
    given: Inputs,
    mode: str = "RGB",
    degree: int | None = None,
    antialiased: bool = False,
    absgrad: bool = False,
) -> tuple[Tensor, Tensor, list[Splats2D]]:
    """The images, alphas and splats of the reference, one camera at a time."""
    images, alphas, each = [], [], []
    for c, (viewmat, K) in enumerate(zip(given.viewmats, given.Ks, strict=True)):
        (fx, _, cx), (_, fy, cy), _ = K.tolist()
        view = View(viewmat[:3], WIDTH, HEIGHT, fx, fy, cx, cy, degree or 0, 0.01, antialiased)
        per_camera = given.colors.dim() == (3 if degree is None else 4)
        splats, _ = reference.project_activated(
            given.means,
            given.scales,
            given.quats,
            given.opacities,
            given.colors[c] if per_camera else given.colors,
            view,
        )
        splats.packed.retain_grad()
        if absgrad:
            splats.abs_grad = torch.zeros_like(splats.means2d)
        each.append(splats)
        image, alpha, depth = reference.rasterize(
            splats, WIDTH, HEIGHT, given.backgrounds[c], with_depth=True
        )
        if mode.endswith("ED"):
            depth = depth / alpha.clamp(min=1e-10)
        parts = [image] if "RGB" in mode else []
        parts += [depth[..., None]] if "D" in mode else []
        images.append(torch.cat(parts, dim=2))
        alphas.append(alpha[..., None])
    return torch.stack(images), torch.stack(alphas), each


def backward(colors: Tensor, alphas: Tensor) -> None:
    """From a random linear function of the results."""
    g = generator(8)
    weights = [normal(g, *t.shape).to(t) for t in (colors, alphas)]
    ((colors * weights[0]).sum() + (alphas * weights[1]).sum()).backward()


def compare(kind: str, dtype: torch.dtype = torch.float64, **options: Any) -> None:
    """Images, alphas and every gradient."""
    tolerance = 1e-5 if dtype == torch.float64 else 1e-3
    degree, mode = options.get("sh_degree"), options.get("render_mode", "RGB")
    antialiased = options.get("rasterize_mode") == "antialiased"
    given, exact = inputs(kind).of(dtype).requiring_grad(), inputs(kind).requiring_grad()
    colors, alphas, _ = given.rendered(**options)
    *wanted, _ = expected(exact, mode, degree, antialiased)
    for found, value in zip((colors, alphas), wanted, strict=True):
        assert found.shape == value.shape
        assert found.dtype == dtype
        assert_close(found, value, tolerance)
    backward(colors, alphas)
    backward(*wanted)
    unused = set() if "RGB" in mode else {"colors", "backgrounds"}
    grads = given.grads()
    assert grads.keys() == vars(given).keys() - {"Ks"} - unused
    for name, grad in grads.items():
        assert_close(grad, exact.grads()[name], tolerance, name)


# Colours, modes, gradients


@pytest.mark.isa
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("mode", MODES)
def test_every_mode_is_that_of_the_reference(mode: str, dtype: torch.dtype) -> None:
    compare("RGB", dtype, render_mode=mode)


@pytest.mark.isa
@pytest.mark.parametrize("packed", [True, False])
@pytest.mark.parametrize("kind", ["1", "5", "9", "40", "RGB per camera"])
def test_colours_and_features(kind: str, packed: bool) -> None:
    compare(kind, packed=packed, render_mode="RGB+D")


@pytest.mark.isa
@pytest.mark.parametrize("kind", ["SH", "SH per camera"])
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_harmonics(kind: str, degree: int) -> None:
    compare(kind, sh_degree=degree)


@pytest.mark.isa
def test_the_mip_filter() -> None:
    compare("SH", rasterize_mode="antialiased", eps2d=0.1, sh_degree=1, render_mode="RGB+ED")


@pytest.mark.emulated
@pytest.mark.parametrize("kind", ["RGB", "9", "SH"])
def test_the_kernels_of_a_gpu(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(LAUNCHERS, "cpu", launcher("emulated"))
    compare(kind, render_mode="RGB+ED", sh_degree=2 if kind == "SH" else None, packed=kind == "9")


@pytest.mark.isa
@pytest.mark.parametrize(("kind", "degree"), [("RGB", None), ("SH", 1)])
def test_finite_differences(kind: str, degree: int | None) -> None:
    given = inputs(kind, 3)
    given.scales += 0.2
    Ks = given.Ks

    def results(*tensors: Tensor) -> tuple[Tensor, Tensor]:
        names = [name for name in vars(given) if name != "Ks"]
        options = {"sh_degree": degree, "render_mode": "RGB+ED"}
        own = dict(zip(names, tensors, strict=True))
        colors, alphas, _ = rasterization(**own, Ks=Ks, width=4, height=3, **options)
        return colors, alphas

    # The images are the upper left corners; the broad Gaussians cover them.
    given.Ks[:, 0, 2], given.Ks[:, 1, 2] = 2.2, 1.6
    leaves = [t.requires_grad_() for n, t in vars(given).items() if n != "Ks"]
    assert bool((results(*leaves)[1] > 0.01).all())
    assert torch.autograd.gradcheck(results, leaves, eps=1e-6, atol=1e-5, rtol=1e-5, fast_mode=True)


@pytest.mark.isa
def test_opaque_and_flat_gaussians_have_gradients() -> None:
    """Of opacity 1, whose logit is infinite; of scale 0, whose logarithm is."""
    given = inputs().of(torch.float32)
    given.opacities[:] = 1.0
    given.scales[:, 2] = 0.0
    given.requiring_grad()
    colors, alphas, _ = given.rendered()
    backward(colors, alphas)
    assert all(bool(grad.isfinite().all()) for grad in given.grads().values())
    near = inputs().of(torch.float32)
    near.opacities[:] = 1.0 - 1e-6
    near.scales[:, 2] = 1e-6
    near.requiring_grad()
    backward(*near.rendered()[:2])
    for name in ("opacities", "means"):
        assert_close(given.grads()[name], near.grads()[name].double(), 1e-2, name)


# Batches and the dictionary of intermediate results


@pytest.mark.isa
def test_the_example_of_the_documentation() -> None:
    g = torch.Generator().manual_seed(0)
    means, quats = torch.randn(100, 3, generator=g), torch.randn(100, 4, generator=g)
    scales, colors = 0.1 * torch.rand(100, 3, generator=g), torch.rand(100, 3, generator=g)
    opacities = torch.rand(100, generator=g)
    viewmats = torch.eye(4)[None]
    Ks = torch.tensor([[[300.0, 0.0, 150.0], [0.0, 300.0, 100.0], [0.0, 0.0, 1.0]]])
    image, alpha, meta = rasterization(
        means, quats, scales, opacities, colors, viewmats, Ks, 300, 200
    )
    assert image.shape == (1, 200, 300, 3)
    assert alpha.shape == (1, 200, 300, 1)
    assert 0 < float(alpha.mean()) < 1
    count = len(meta["gaussian_ids"])
    assert 0 < count < 100
    assert (means[meta["gaussian_ids"], 2] > 0.01).all()
    for name, columns in (("means2d", 2), ("conics", 3), ("radii", 2)):
        assert meta[name].shape == (count, columns), name
    for name in ("depths", "opacities", "camera_ids", "batch_ids"):
        assert meta[name].shape == (count,), name
    assert (meta["radii"] > 0).all()
    torch.testing.assert_close(meta["depths"], means[meta["gaussian_ids"], 2])
    torch.testing.assert_close(meta["opacities"], opacities[meta["gaussian_ids"]])
    assert (meta["width"], meta["height"], meta["n_cameras"]) == (300, 200, 1)
    assert (meta["tile_size"], meta["tile_width"], meta["tile_height"]) == (16, 19, 13)


@pytest.mark.isa
@pytest.mark.parametrize("kind", ["RGB", "SH per camera"])
def test_batches_of_scenes(kind: str) -> None:
    """Two batch dimensions, of 2 and 1: each item is a call of its own."""
    degree = 2 if "SH" in kind else None
    one, other = inputs(kind), inputs(kind)
    other.means[:, 0] += 0.1
    other.colors += 0.2
    both = Inputs(
        **{n: torch.stack([t, vars(other)[n]])[:, None] for n, t in vars(one).items()}
    ).requiring_grad()
    colors, alphas, meta = both.rendered(sh_degree=degree)
    assert colors.shape == (2, 1, 2, HEIGHT, WIDTH, 3)
    assert alphas.shape == (2, 1, 2, HEIGHT, WIDTH, 1)
    assert (meta["n_batches"], meta["n_cameras"]) == (2, 2)
    assert set(meta["batch_ids"].tolist()) == {0, 1} == set(meta["camera_ids"].tolist())
    for i, item in enumerate((one, other)):
        assert torch.equal(colors[i, 0], item.rendered(sh_degree=degree)[0])
    backward(colors, alphas)
    assert all(bool(grad[1].any()) for grad in both.grads().values())
    dense = both.rendered(sh_degree=degree, packed=False)[2]
    assert dense["means2d"].shape == (2, 1, 2, 40, 2)
    assert dense["gaussian_ids"] is None


@pytest.mark.isa
def test_rows_of_every_gaussian() -> None:
    """With packed=False, a row of zeros for each Gaussian that is not visible."""
    few, every = inputs().rendered()[2], inputs().rendered(packed=False)[2]
    rows = few["camera_ids"], few["gaussian_ids"]
    for name in ("means2d", "conics", "depths", "opacities", "radii"):
        assert torch.equal(every[name][rows], few[name]), name
        assert int((every["depths"] != 0).sum()) == len(few["depths"]) < 80


@pytest.mark.isa
@pytest.mark.parametrize("cameras", [1, 2])
@pytest.mark.parametrize("packed", [True, False])
def test_the_gradient_of_the_centres(packed: bool, cameras: int) -> None:
    """A density control retains it; a regulariser of the centres reaches the means."""

    def inputs_of_cameras() -> Inputs:
        given = inputs()
        for name in ("viewmats", "Ks", "backgrounds"):
            setattr(given, name, vars(given)[name][:cameras])
        return given.requiring_grad()

    given, exact = inputs_of_cameras(), inputs_of_cameras()
    colors, alphas, meta = given.rendered(packed=packed)
    meta["means2d"].retain_grad()
    wanted_colors, wanted_alphas, splats = expected(exact)
    for image, alpha, centres in (
        (colors, alphas, [meta["means2d"]]),
        (wanted_colors, wanted_alphas, [found.means2d for found in splats]),
    ):
        regulariser = torch.stack([(0.01 * part**2).sum() for part in centres]).sum()
        regulariser.backward(retain_graph=True)
        backward(image, alpha)
    found = meta["means2d"].grad
    if not packed:
        seen = meta["depths"] > 0
        assert not found[~seen].any()
        found = found[seen]
    grads = [part.packed.grad for part in splats]
    assert_close(found, torch.cat([grad[:, :2] for grad in grads if grad is not None]), 1e-5)
    assert_close(given.grads()["means"], exact.grads()["means"], 1e-5)


@pytest.mark.isa
def test_limits_of_depth_and_radius() -> None:
    given = inputs()
    depths, radii = (given.rendered()[2][name] for name in ("depths", "radii"))
    for options, kept in (
        ({"near_plane": 3.0}, depths > 3.0),
        ({"far_plane": 3.0}, depths <= 3.0),
        ({"radius_clip": 8.0}, radii[:, 0] > 8),
    ):
        meta = given.rendered(**options)[2]
        assert 0 < int(kept.sum()) < len(kept)
        assert torch.equal(meta["depths"], depths[kept]), options
    nothing, alphas, meta = given.rendered(near_plane=100.0)
    assert len(meta["means2d"]) == 0
    assert not alphas.any()
    assert torch.equal(nothing, given.backgrounds[:, None, None].expand_as(nothing))


# The call


def test_the_arguments_are_those_of_gsplat() -> None:
    """Their names, order and defaults."""
    tensors = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks")
    wanted = {
        **dict.fromkeys((*tensors, "width", "height"), inspect.Parameter.empty),
        "near_plane": 0.01,
        "far_plane": 1e10,
        "radius_clip": 0.0,
        "eps2d": 0.3,
        "sh_degree": None,
        "packed": True,
        "tile_size": None,
        "backgrounds": None,
        "render_mode": "RGB",
        "sparse_grad": False,
        "absgrad": False,
        "rasterize_mode": "classic",
        "channel_chunk": 32,
        "distributed": False,
        "camera_model": "pinhole",
        "segmented": False,
        "covars": None,
        "with_ut": False,
        "with_eval3d": False,
        "return_normals": False,
        "global_z_order": True,
        "rays": None,
        "radial_coeffs": None,
        "tangential_coeffs": None,
        "thin_prism_coeffs": None,
        "ftheta_coeffs": None,
        "lidar_coeffs": None,
        "external_distortion_coeffs": None,
        "rolling_shutter": None,  # RollingShutterType.GLOBAL
        "viewmats_rs": None,
        "ut_params": None,
        "extra_signals": None,
        "extra_signals_sh_degree": None,
        "renderer_config": None,
    }
    parameters = inspect.signature(snowsplat.rasterization).parameters
    assert {p.kind for p in parameters.values()} == {inspect.Parameter.POSITIONAL_OR_KEYWORD}
    found = {name: parameter.default for name, parameter in parameters.items()}
    assert list(found.items()) == list(wanted.items())


@pytest.mark.parametrize(
    "options",
    [
        {"camera_model": "fisheye"},
        {"camera_model": "ortho"},
        {"distributed": True},
        {"sparse_grad": True, **{n: t[None] for n, t in vars(inputs()).items()}},
        {"extra_signals_sh_degree": 4},
        {"with_ut": True},
        {"with_eval3d": True},
        {"radial_coeffs": torch.zeros(2, 6)},
        {"eps2d": 0.0},
        {"rasterize_mode": "mip"},
        {"render_mode": "N"},
        {"sh_degree": 4},
    ],
    ids=str,
)
def test_what_is_not_supported_is_refused_by_name(options: dict[str, Any]) -> None:
    given = {**vars(inputs()), "width": WIDTH, "height": HEIGHT}
    with pytest.raises(UserError, match=r"^rasterization: ") as caught:
        rasterization(**{**given, **options})
    assert one_line(caught.value)
    assert next(iter(options)) in str(caught.value)
    assert ";" in str(caught.value)


@pytest.mark.isa
def test_the_defaults_of_other_arguments_are_accepted() -> None:
    given = inputs()

    class RendererConfig_MixedBatch:
        pass

    others = {name: value for name, (value, _) in module._FIXED.items()}
    others["renderer_config"] = RendererConfig_MixedBatch()
    speed = {"tile_size": 8, "channel_chunk": 1, "packed": False, "segmented": True}
    assert torch.equal(given.rendered(**others, **speed)[0], given.rendered()[0])


@pytest.mark.isa
@pytest.mark.parametrize(
    ("mode", "eps2d"), [("antialiased", 0.3), ("classic", 0.1), ("classic", 2)]
)
@pytest.mark.parametrize("with_covars", [False, True])
def test_other_filters_and_covariances(
    mode: str, eps2d: float, with_covars: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reference, "LOW_PASS", eps2d)
    monkeypatch.setattr(reference, "MIP_LOW_PASS", eps2d)
    given, exact = inputs().requiring_grad(), inputs().requiring_grad()
    options = dict(vars(given), width=WIDTH, height=HEIGHT, rasterize_mode=mode, eps2d=eps2d)
    if with_covars:
        factors = reference._rotation_matrices(given.quats) * given.scales[:, None, :]
        options |= {"covars": factors @ factors.mT, "quats": None, "scales": None}
    colors, alphas, _ = rasterization(**options)
    *wanted, _ = expected(exact, antialiased=mode == "antialiased")
    for found, value in zip((colors, alphas), wanted, strict=True):
        assert_close(found, value, 1e-5)
    backward(colors, alphas)
    backward(*wanted)
    for name, grad in given.grads().items():
        assert_close(grad, exact.grads()[name], 1e-4, name)


@pytest.mark.isa
@pytest.mark.parametrize("packed", [True, False])
def test_absolute_gradients(packed: bool) -> None:
    """Those of the reference: sums over tiles."""
    given, exact = inputs().requiring_grad(), inputs().requiring_grad()
    colors, alphas, meta = given.rendered(packed=packed, absgrad=True)
    assert not meta["means2d"].absgrad.any()
    backward(colors, alphas)
    wanted = expected(exact, absgrad=True)
    backward(*wanted[:2])
    found = meta["means2d"].absgrad
    assert found.shape == meta["means2d"].shape
    if not packed:
        assert not found[meta["depths"] == 0].any()
        found = found[meta["depths"] != 0]
    assert_close(found, torch.cat([splats.abs_grad for splats in wanted[2]]), 1e-5)


@pytest.mark.parametrize("packed", [True, False])
def test_absolute_gradients_of_many_channels(packed: bool) -> None:
    """The sum over groups of four channels."""
    sums = []
    for columns in (slice(0, 6), slice(0, 4), slice(4, 6)):
        given = inputs("6").requiring_grad()
        colors, _, meta = given.rendered(packed=packed, absgrad=True)
        colors[..., columns].square().sum().backward()
        sums.append(meta["means2d"].absgrad)
    assert sums[2].any()
    assert_close(sums[0], sums[1] + sums[2], 1e-6)


@pytest.mark.parametrize("with_covars", [False, True])
def test_sparse_gradients(with_covars: bool) -> None:
    """Of means, quats and scales, for the rows of the visible Gaussians."""
    given, dense = inputs().requiring_grad(), inputs().requiring_grad()
    covars = 0.04 * torch.eye(3, dtype=torch.float64).expand(40, 3, 3) if with_covars else None
    colors, alphas, meta = given.rendered(sparse_grad=True, covars=covars)
    backward(colors, alphas)
    backward(*dense.rendered(covars=covars)[:2])
    grads = given.grads()
    assert grads.keys() == dense.grads().keys()
    for name, grad in grads.items():
        assert grad.is_sparse == (name in ("means", "quats", "scales"))
        if grad.is_sparse:
            assert torch.equal(grad.coalesce().indices()[0], meta["gaussian_ids"].unique())
            grad = grad.to_dense()
        assert_close(grad, dense.grads()[name], 1e-9, name)
    dense = inputs().requiring_grad()
    backward(*dense.rendered(sparse_grad=True, packed=False)[:2])
    assert not any(grad.is_sparse for grad in dense.grads().values())


@pytest.mark.parametrize("kind", ["RGB", "RGB per camera", "SH", "SH per camera"])
@pytest.mark.parametrize("mode", ["RGB", "RGB+ED", "ED"])
@pytest.mark.parametrize("signals", ["features", "features per camera", "harmonics"])
def test_extra_signals(signals: str, mode: str, kind: str) -> None:
    """The same images as those of calls of their own, and the gradients of both."""
    degree = 2 if "SH" in kind else None
    shape = {"features": (40, 2), "features per camera": (2, 40, 2), "harmonics": (40, 4, 3)}
    extra = (0.5 + 0.1 * normal(generator(5), *shape[signals])).requires_grad_()
    of_extra = 1 if signals == "harmonics" else None
    given, apart = inputs(kind).requiring_grad(), inputs(kind).requiring_grad()
    colors, alphas, meta = given.rendered(
        render_mode=mode, sh_degree=degree, extra_signals=extra, extra_signals_sh_degree=of_extra
    )
    wanted = apart.rendered(render_mode=mode, sh_degree=degree)
    assert_close(colors, wanted[0], 1e-9)
    assert_close(alphas, wanted[1], 1e-9)
    once = {**vars(apart), "colors": extra, "backgrounds": None}
    signal = rasterization(**once, width=WIDTH, height=HEIGHT, sh_degree=of_extra)[0]
    assert_close(meta["render_extra_signals"], signal, 1e-9)
    (colors.square().sum() + meta["render_extra_signals"].square().sum()).backward()
    found, extra.grad = extra.grad, None
    (wanted[0].square().sum() + signal.square().sum()).backward()
    assert_close(found, extra.grad, 1e-9)
    grads = given.grads()
    assert grads.keys() == apart.grads().keys()
    for name, grad in grads.items():
        assert_close(grad, apart.grads()[name], 1e-9, name)


def test_extra_signals_of_batches_and_of_wrong_shapes() -> None:
    given = inputs("SH")
    options: dict[str, Any] = {"sh_degree": 1, "extra_signals_sh_degree": 1}
    options["extra_signals"] = torch.full((40, 4, 1), -3.0, dtype=torch.float64)
    batch = Inputs(
        **{n: t if n == "colors" else torch.stack([t, t]) for n, t in vars(given).items()}
    )
    found = batch.rendered(**options)
    wanted = given.rendered(**options)
    assert_close(found[0][1], wanted[0], 1e-9)
    signals = [meta["render_extra_signals"] for _, _, meta in (found, wanted)]
    assert signals[0].min() < 0
    assert_close(signals[0][1], signals[1], 1e-9)
    for wrong, degree in (
        (torch.zeros(39, 2), None),
        (torch.zeros(3, 40, 2), None),
        (torch.zeros(40, 4), 1),
        (torch.zeros(40, 1, 3), 1),
    ):
        with pytest.raises(ValueError, match="extra_signals must be|needs 4, got 1"):
            inputs().rendered(extra_signals=wrong.double(), extra_signals_sh_degree=degree)


@pytest.mark.isa
@pytest.mark.parametrize("packed", [True, False])
def test_edges_of_tensors(packed: bool) -> None:
    """No Gaussians, signed scales, no colours, harmonics shared by a batch."""
    given = inputs()
    plain = given.rendered(packed=packed)
    nothing = {
        n: t[:0] for n, t in vars(given).items() if n not in ("viewmats", "Ks", "backgrounds")
    }
    empty = Inputs(**{**vars(given), **nothing}).rendered(packed=packed)
    assert torch.equal(empty[0], given.backgrounds[:, None, None].expand_as(empty[0]))
    assert not empty[1].any()
    given.scales *= torch.tensor([1.0, -1.0, -1.0])
    assert torch.equal(given.rendered(packed=packed)[0], plain[0])
    depth = given.rendered(packed=packed, render_mode="D")[0]
    given.colors = None  # type: ignore[assignment]
    assert torch.equal(given.rendered(packed=packed, render_mode="D")[0], depth)
    with pytest.raises(ValueError, match="colors are needed"):
        given.rendered()
    one = inputs("SH")
    both = Inputs(**{n: torch.stack([t, t]) for n, t in vars(one).items()})
    both.colors = one.colors
    found = both.rendered(sh_degree=3, packed=packed)[0]
    assert torch.equal(found[1], one.rendered(sh_degree=3)[0])


def test_a_size_that_is_no_integer_breaks_no_later_call() -> None:
    given = inputs()
    before = given.rendered()[0]
    with pytest.raises(ValueError, match="width and height must be int, got 30.0"):
        rasterization(**vars(given), width=30.0, height=HEIGHT)  # type: ignore[arg-type]
    with pytest.raises(TypeError):
        scratch.empty((3e5, 2), torch.float32)  # type: ignore[arg-type]
    assert torch.equal(given.rendered()[0], before)


@pytest.mark.nightly  # loads the compiler of PyTorch
def test_torch_compile_breaks_its_graph() -> None:
    given = inputs()
    call = torch.compile(lambda: given.rendered()[0], backend="eager")
    assert torch.equal(call(), given.rendered()[0])


def test_skewed_intrinsics_are_refused() -> None:
    given = inputs()
    given.Ks[1, 0, 1] = 0.5
    with pytest.raises(UserError, match=r"Ks has the skew 0.5; undistort"):
        given.rendered()


@pytest.mark.parametrize("name", ["quats", "scales", "opacities", "colors", "viewmats", "Ks"])
def test_wrong_shapes_name_the_argument(name: str) -> None:
    given = inputs()
    setattr(given, name, vars(given)[name][..., :-1])
    if name == "colors":
        given.colors = given.colors[:-1]
    with pytest.raises(ValueError, match=f"^rasterization: {name} must be ") as caught:
        given.rendered()
    assert one_line(caught.value)


def test_one_camera_needs_a_dimension_too() -> None:
    given = inputs()
    given.viewmats, given.Ks = given.viewmats[0], given.Ks[0]
    with pytest.raises(ValueError, match=r"viewmats must be \('C', 4, 4\), .*: viewmats\[None\]"):
        given.rendered()
