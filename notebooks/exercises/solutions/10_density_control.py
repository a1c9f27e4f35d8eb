import torch

from snowsplat.scene.geometry import rotation_from_quat


def statistic(gradients, width, height):
    norms = (gradients * torch.tensor([width / 2, height / 2])).norm(dim=2)
    return norms.nanmean(dim=0).nan_to_num(0)


def refine(means, log_scales, quats, opacities, tau, noise, threshold=2e-4, small=0.1):
    alive = opacities >= 0.005
    dense = alive & (tau > threshold)
    split = dense & (log_scales.exp().amax(dim=1) > small)
    kept, clones, parents = (r.nonzero()[:, 0] for r in (alive & ~split, dense & ~split, split))
    rows = torch.cat([kept, clones, parents, parents])
    new_means, new_scales = means[rows], log_scales[rows]
    children = rows[len(kept) + len(clones) :]
    epsilon = torch.cat([noise[0, parents], noise[1, parents]])
    offsets = (
        rotation_from_quat(quats[children]) @ (log_scales[children].exp() * epsilon)[:, :, None]
    )
    new_means[len(rows) - len(children) :] += offsets[:, :, 0]
    new_scales[len(rows) - len(children) :] -= torch.tensor(1.6).log()
    return rows, new_means, new_scales
