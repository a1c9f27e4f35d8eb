import torch


def first_log_scales(points):
    distances = torch.cdist(points, points, compute_mode="donot_use_mm_for_euclid_dist")
    nearest = distances.sort(dim=1).values[:, 1:4]
    return nearest.mean(dim=1).log()


def adam(p, g, m, v, step, rate, betas=(0.9, 0.999), eps=1e-15):
    m = betas[0] * m + (1 - betas[0]) * g
    v = betas[1] * v + (1 - betas[1]) * g * g
    m_hat, v_hat = m / (1 - betas[0] ** step), v / (1 - betas[1] ** step)
    return p - rate * m_hat / (v_hat + eps**2).sqrt(), m, v
