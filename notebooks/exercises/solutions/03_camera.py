import torch


def to_pixels(points, pose, fx, fy, cx, cy):
    x, y, z = (points @ pose[:, :3].T + pose[:, 3]).unbind(dim=1)
    return torch.stack([fx * x / z + cx, fy * y / z + cy], dim=1), z


def camera_position(pose):
    return -pose[:, :3].T @ pose[:, 3]


def from_pixels(pixels, depths, pose, fx, fy, cx, cy):
    x = (pixels[:, 0] - cx) / fx * depths
    y = (pixels[:, 1] - cy) / fy * depths
    return (torch.stack([x, y, depths], dim=1) - pose[:, 3]) @ pose[:, :3]
