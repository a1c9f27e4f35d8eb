import torch


def epipolar_lines(pixels, pose_a, pose_b):
    R = pose_b[:, :3] @ pose_a[:, :3].T
    t = pose_b[:, 3] - R @ pose_a[:, 3]
    rays = torch.cat([pixels, torch.ones(len(pixels), 1)], dim=1) @ R.T
    lines = torch.linalg.cross(t.expand_as(rays), rays)
    return lines / lines[:, :2].norm(dim=1, keepdim=True)


def triangulate(pixels, poses):
    rows = (pixels[:, :, None] * poses[:, 2:] - poses[:, :2]).reshape(-1, 4)
    return torch.linalg.lstsq(rows[:, :3], -rows[:, 3:]).solution[:, 0]


def angle(point, poses):
    rays = point + (poses[:, :, :3].mT @ poses[:, :, 3:])[:, :, 0]
    rays = rays / rays.norm(dim=1, keepdim=True)
    return torch.rad2deg(torch.acos((rays @ rays.T).clamp(-1, 1).min()))
