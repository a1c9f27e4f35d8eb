import torch


def blend(alphas, colors, background):
    color, T = torch.zeros(3), torch.ones(())
    for alpha, c in zip(alphas.clamp(max=0.99), colors, strict=True):
        if alpha < 1 / 255:
            continue
        if T * (1 - alpha) < 1e-4:
            break
        color = color + T * alpha * c
        T = T * (1 - alpha)
    return color + T * background, T


def blend_tile(alphas, colors, background):
    alphas = alphas.clamp(max=0.99) * (alphas >= 1 / 255)
    after = torch.cumprod(1 - alphas, dim=1)
    alphas = torch.where(after < 1e-4, 0.0, alphas)  # the product decreases: a pixel stays stopped
    after = torch.cumprod(1 - alphas, dim=1)
    before = torch.cat([torch.ones(len(alphas), 1), after[:, :-1]], dim=1)
    return (before * alphas) @ colors + after[:, -1:] * background, after[:, -1]
