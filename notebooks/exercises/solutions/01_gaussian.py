import torch


def splat(mean, covariance):
    c = covariance.inverse()[2, 2]
    return mean[:2], covariance[:2, :2], (2 * torch.pi / c).sqrt()
