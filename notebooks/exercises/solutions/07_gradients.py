import torch


def gradients(alphas, colors, background, g):
    T = torch.cat([torch.ones(1), (1 - alphas).cumprod(dim=0)[:-1]])
    of_alphas, behind = torch.zeros_like(alphas), background
    for i in reversed(range(len(alphas))):
        of_alphas[i] = T[i] * g @ (colors[i] - behind)
        behind = alphas[i] * colors[i] + (1 - alphas[i]) * behind
    return of_alphas, (T * alphas)[:, None] * g
