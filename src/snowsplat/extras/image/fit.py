"""`Fitter`: finds the Gaussians of an image by gradient descent.

The loss is the squared error, which is what PSNR measures. The first Gaussians are placed where the
image has large gradients. More are added later, where the squared error is large, so that they go
where they are needed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from snowsplat import ops
from snowsplat.extras.image.options import Blending, FitOptions
from snowsplat.ops.splats import Splats2D

# The values below were chosen by measuring the PSNR of 1000 Gaussians after the same number of
# steps; docs/guides/image.md has the figures.
_BETAS = (0.8, 0.98)
_EPS = 1e-12
# Learning rates of the first step. The rates decrease to 0 with half a period of a cosine.
_RATES = {"log_sigmas": 0.06, "angle": 0.06, "colors": 0.04, "opacity_logit": 0.1}
_MEAN_RATE = 0.033  # times the mean distance of the Gaussians, in pixels
_BACKGROUND_RATE = 0.003
_SMALLEST_SIGMA = 0.25  # pixels; a smaller Gaussian could lie between the centres of all pixels
_FIRST_SHARE = 0.15  # of the Gaussians: those of the first step
_ROUNDS = 10  # number of times that others are added
_LAST_ROUND = 0.4  # of the steps
# The density of the first Gaussians is proportional to the gradient of the image, plus this share
# of a uniform density.
_UNIFORM_SHARE = 0.3
_FIRST_SIGMAS = (0.7, 30.0)  # pixels; limits of the first Gaussians
# The density of new Gaussians is proportional to (error²)^1.5.
_ERROR_POWER = 1.5
_NEW_SIGMA = 0.4  # times the mean distance of the Gaussians
_NEW_OPACITY = 0.12  # of front-to-back Gaussians
# Columns of `ImageGaussians.rows`.
MEANS = slice(0, 2)
LOG_SIGMAS = slice(2, 4)
ANGLE = 4
COLORS = slice(5, 8)
OPACITY_LOGIT = 8


class Fitter:
    """Fits Gaussians to an image, step by step.

        fitter = Fitter(photo, FitOptions(gaussians=1000))
        while not fitter.finished:
            fitter.step()
        image = fitter.gaussians.render()

    ``target``: the image (H, W, 3) in 0..1, float32.

    Attributes:
        steps_done: number of steps so far.
        mse: the mean squared error before the last step.
    """

    def __init__(self, target: Tensor, options: FitOptions) -> None:
        self.options = options
        self.steps_done = 0
        self.mse = math.nan
        self._target = target.permute(2, 0, 1).contiguous()
        self._generator = torch.Generator().manual_seed(options.seed)
        height, width = target.shape[:2]
        self._spacing = math.sqrt(height * width / options.gaussians)  # pixels between Gaussians
        # Step numbers after which Gaussians are added, with the number of Gaussians then.
        first = max(1, round(_FIRST_SHARE * options.gaussians))
        self._counts = {
            round(options.steps * _LAST_ROUND * k / _ROUNDS): first
            + (options.gaussians - first) * k // _ROUNDS
            for k in range(_ROUNDS + 1)
        }
        self._background = target.mean((0, 1))
        self._rows = self._first_rows(self._counts[0])
        rates = [_MEAN_RATE * self._spacing] * 2 + [_RATES["log_sigmas"]] * 2 + [_RATES["angle"]]
        rates += [_RATES["colors"]] * 3 + [_RATES["opacity_logit"]]
        columns = column_count(options.blending)
        self._row_adam = _Adam(self._rows, torch.tensor(rates[:columns]))
        self._background_adam = _Adam(self._background, torch.tensor(_BACKGROUND_RATE))

    @property
    def finished(self) -> bool:
        """Whether all steps are done."""
        return self.steps_done >= self.options.steps

    @property
    def gaussian_count(self) -> int:
        """Number of Gaussians now."""
        return len(self._rows)

    @property
    def gaussians(self) -> ImageGaussians:
        """The Gaussians now, as a copy."""
        return self._model(self._rows.clone(), self._background.clone())

    def step(self) -> None:
        """One step of Adam; at some steps, adds Gaussians."""
        rows = self._rows.requires_grad_()
        background = self._background.requires_grad_()
        image = self._model(rows, background).render()
        error = image.detach().permute(2, 0, 1) - self._target  # (3, H, W)
        # ½ Σ error²: Adam ignores the scale of the loss.
        grads = torch.autograd.grad(image, (rows, background), error.permute(1, 2, 0))
        self._rows, self._background = rows.detach(), background.detach()
        rate = 0.5 + 0.5 * math.cos(math.pi * self.steps_done / self.options.steps)
        self._row_adam.step(self._rows, grads[0], rate)
        self._background_adam.step(self._background, grads[1], rate)
        self._rows[:, LOG_SIGMAS].clamp_(min=math.log(_SMALLEST_SIGMA))
        if self.options.blending == "front-to-back":
            self._rows[:, COLORS].clamp_(0, 1)
        self.mse = float(error.square().mean())
        self.steps_done += 1
        if self._counts.get(self.steps_done, 0) > len(self._rows):
            self._add(self._counts[self.steps_done] - len(self._rows), error)

    def _model(self, rows: Tensor, background: Tensor) -> ImageGaussians:
        height, width = self._target.shape[1:]
        return ImageGaussians(width, height, self.options.blending, rows, background)

    def _first_rows(self, count: int) -> Tensor:
        """(count, C): Gaussians whose size is about half of the distance to the next ones."""
        slope = _gradient_norm(self._target)
        share = (1 - _UNIFORM_SHARE) * slope / slope.sum().clamp(min=1e-12)
        density = share + (1 - share.sum()) / slope.numel()
        x, y = self._sample(density, count)
        sigmas = (0.5 * (density[y, x] * count).rsqrt()).clamp(_FIRST_SIGMAS[0], _FIRST_SIGMAS[1])
        colors = self._target[:, y, x].T
        if self.options.blending == "additive":
            colors = 0.5 * (colors - self._background)
        return self._new_rows(x, y, sigmas, colors, opacity=0.5)

    def _add(self, count: int, error: Tensor) -> None:
        """Add Gaussians at random positions, more of them where the error (3, H, W) is large.

        Additive Gaussians begin with a part of the missing colour. Others are put in front, with
        the colour of the photo and a low opacity.
        """
        squared = error.square().sum(0) ** _ERROR_POWER
        around = torch.nn.functional.avg_pool2d(squared[None, None], 3, 1, 1)[0, 0]
        x, y = self._sample(around, count)
        sigmas = torch.full((count,), max(_NEW_SIGMA * self._spacing, _SMALLEST_SIGMA))
        if self.options.blending == "additive":
            rows = self._new_rows(x, y, sigmas, -0.5 * error[:, y, x].T, opacity=1.0)
        else:
            rows = self._new_rows(x, y, sigmas, self._target[:, y, x].T, _NEW_OPACITY)
        self._rows = torch.cat([rows, self._rows])
        self._row_adam.prepend(count)

    def _sample(self, density: Tensor, count: int) -> tuple[Tensor, Tensor]:
        """x and y (count,) of random positions, in pixels, with a density (H, W).

        Systematic sampling: one position in each of `count` equal parts of the cumulative density.
        So the number of positions in an area varies less than for independent positions.
        """
        cumulative = (density.double().flatten() + 1e-30).cumsum(0)
        parts = torch.arange(count) + torch.rand(count, generator=self._generator).double()
        index = torch.searchsorted(cumulative, parts / count * cumulative[-1])
        index = index.clamp(max=density.numel() - 1)
        return index % density.shape[1], index // density.shape[1]

    def _new_rows(
        self, x: Tensor, y: Tensor, sigmas: Tensor, colors: Tensor, opacity: float
    ) -> Tensor:
        """(K, C): round Gaussians at random positions in the pixels (x, y)."""
        rows = torch.zeros(len(x), column_count(self.options.blending))
        offsets = torch.rand(len(x), 2, generator=self._generator)
        rows[:, MEANS] = torch.stack([x, y], dim=1) + offsets
        rows[:, LOG_SIGMAS] = sigmas.log()[:, None]
        rows[:, COLORS] = colors
        if self.options.blending == "front-to-back":
            rows[:, OPACITY_LOGIT] = math.log(opacity / (1 - opacity))
        return rows


class _Adam:
    """Adam (Kingma and Ba 2015) with a learning rate per column.

    torch.optim imports PyTorch's compiler, which takes seconds.
    """

    def __init__(self, values: Tensor, rates: Tensor) -> None:
        self._rates = rates
        self._m, self._v = torch.zeros_like(values), torch.zeros_like(values)
        self._steps = 0

    def step(self, values: Tensor, grad: Tensor, factor: float) -> None:
        """Update `values` in place; the learning rates are multiplied by `factor`."""
        self._steps += 1
        (beta1, beta2), steps = _BETAS, self._steps
        self._m.lerp_(grad, 1 - beta1)
        self._v.mul_(beta2).addcmul_(grad, grad, value=1 - beta2)
        factor *= math.sqrt(1 - beta2**steps) / (1 - beta1**steps)
        values.addcdiv_(self._m * self._rates, self._v.sqrt().add_(_EPS), value=-factor)

    def prepend(self, count: int) -> None:
        """Insert `count` new rows before the others."""
        zeros = self._m.new_zeros(count, self._m.shape[1])
        self._m, self._v = torch.cat([zeros, self._m]), torch.cat([zeros, self._v])


def _gradient_norm(image: Tensor) -> Tensor:
    """(H, W): the norm of the gradient of an image (C, H, W), by central differences."""
    padded = torch.nn.functional.pad(image[None], (1, 1, 1, 1), mode="replicate")[0]
    along_x = padded[:, 1:-1, 2:] - padded[:, 1:-1, :-2]
    along_y = padded[:, 2:, 1:-1] - padded[:, :-2, 1:-1]
    return (0.25 * (along_x.square() + along_y.square()).sum(0)).sqrt()


def column_count(blending: Blending) -> int:
    """Number of columns of `ImageGaussians.rows`: additive Gaussians have no opacity."""
    return 8 if blending == "additive" else 9


@dataclass(frozen=True)
class ImageGaussians:
    """2D Gaussians on an image, in pixels. Pixel (i, j) is centred at (i + 0.5, j + 0.5).

    The columns of a row of `rows`:

        0:2   x, y of the centre
        2:4   log σ along the two axes
        4     angle between the x axis of the image and the first axis, in radians
        5:8   red, green, blue; 1 is white. Colours of additive Gaussians may be negative
        8     logit of the opacity; only for front-to-back blending
    """

    width: int  # of the image, in pixels
    height: int  # of the image, in pixels
    blending: Blending  # how the Gaussians are blended
    # (N, 8) for additive, (N, 9) for front-to-back blending, float32. In the latter, the first row
    # is in front.
    rows: Tensor
    background: Tensor  # (3,) the colour behind the Gaussians, float32

    def __post_init__(self) -> None:
        columns = column_count(self.blending)
        if self.rows.dim() != 2 or self.rows.shape[1] != columns:
            raise ValueError(
                f"ImageGaussians: rows must be (N, {columns}) for {self.blending} blending, "
                f"got {tuple(self.rows.shape)}"
            )

    def __len__(self) -> int:
        return len(self.rows)

    def splats(self, scale: float = 1.0) -> Splats2D:
        """The rows as splats of an image that is `scale` times as large; differentiable.

        The covariance is R diag(σ₁², σ₂²) Rᵀ, where R rotates by the angle. Its inverse, the conic,
        is R diag(σ₁⁻², σ₂⁻²) Rᵀ.
        """
        x, y, log_u, log_v, angle, red, green, blue, *logits = self.rows.unbind(dim=1)
        cos, sin = torch.cos(angle), torch.sin(angle)
        u, v = torch.exp(-2 * log_u), torch.exp(-2 * log_v)
        a, b, c = cos * cos * u + sin * sin * v, cos * sin * (u - v), sin * sin * u + cos * cos * v
        if scale != 1.0:
            x, y = x * scale, y * scale
            a, b, c = (value / scale**2 for value in (a, b, c))
        zero = torch.zeros_like(x)
        opacity = torch.sigmoid(logits[0]) if logits else torch.ones_like(x)
        # Equal depths: the splats are in the order of their rows. The radii are not used.
        columns = [x, y, a, b, c, opacity, zero, zero, red, green, blue, *[zero] * 5]
        return Splats2D(torch.stack(columns, dim=1), None, 3)

    def render(self, scale: float = 1.0) -> Tensor:
        """The image (scale · H, scale · W, 3), rounded; not limited to 0..1; differentiable."""
        size = round(self.width * scale), round(self.height * scale)
        additive = self.blending == "additive"
        return ops.rasterize(self.splats(scale), *size, self.background, additive=additive)[0]
