import torch


def jacobian(point, fx, fy):
    x, y, z = point
    zero = torch.zeros_like(z)
    rows = [fx / z, zero, -fx * x / z**2, zero, fy / z, -fy * y / z**2]
    return torch.stack(rows).reshape(2, 3)


def conic(mean, covariance, pose, fx, fy):
    W, t = pose[:, :3], pose[:, 3]
    JW = jacobian(W @ mean + t, fx, fy) @ W
    (a, b), (_, c) = (JW @ covariance @ JW.T + 0.3 * torch.eye(2)).inverse()
    return torch.stack([a, b, c])
