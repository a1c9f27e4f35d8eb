import torch


def median_depth(alphas, depths):
    T = torch.cumprod(torch.cat([torch.ones(1), 1 - alphas[:-1]]), dim=0)
    return depths[T >= 0.5][-1]


def signed_distances(points, depth_map, pose, f, c, truncation):
    x, y, z = (points @ pose[:, :3].T + pose[:, 3]).unbind(dim=1)
    column, row = ((f * v / z + c).floor().long() for v in (x, y))
    height, width = depth_map.shape
    inside = (z > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    depths = depth_map[row.clamp(0, height - 1), column.clamp(0, width - 1)]
    distances = (depths - z) / truncation
    return distances.clamp(max=1), (inside & (distances >= -1)).to(distances)


def fused(distances, weights):
    total = torch.where(weights > 0, distances * weights, 0.0).sum(dim=0)
    return total / weights.sum(dim=0)
