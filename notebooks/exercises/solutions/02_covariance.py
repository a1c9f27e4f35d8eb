import torch


def rotation(quats):
    w, x, y, z = (quats / quats.norm(dim=1, keepdim=True)).unbind(dim=1)
    entries = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(entries, dim=1).reshape(-1, 3, 3)


def covariance(log_scales, quats):
    factor = rotation(quats) * log_scales.exp()[:, None, :]
    return factor @ factor.transpose(1, 2)


def gradient_of_log_scales(log_scales, quats, G):
    R = rotation(quats)
    return 2 * (2 * log_scales).exp() * torch.einsum("nji,njk,nki->ni", R, G, R)
