from math import sqrt

import torch
from torch import pi


def basis(directions):
    x, y, z = directions.unbind(dim=1)
    first, second = sqrt(3 / (4 * pi)), sqrt(15 / (4 * pi))
    functions = [
        torch.full_like(x, 0.5 / sqrt(pi)),
        *(-first * y, first * z, -first * x),
        *(second * x * y, -second * y * z, sqrt(5 / (16 * pi)) * (2 * z * z - x * x - y * y)),
        *(-second * x * z, second / 2 * (x * x - y * y)),
    ]
    return torch.stack(functions, dim=1)


def colors(directions, coefficients):
    return (0.5 + basis(directions) @ coefficients).clamp(min=0)


def gradient(directions, coefficients, g):
    return basis(directions).T @ (g * (colors(directions, coefficients) > 0))
