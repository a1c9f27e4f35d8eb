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
