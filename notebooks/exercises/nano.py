"""3D Gaussian Splatting in one file of plain PyTorch: the ten exercises, put together.

    snowsplat demo                                  takes photos, and finds their poses
    python nano.py snowsplat_demo/made/dataset      trains, and writes nano.ply

Names and equations are those of the course; each part names its page in docs/learn.
A dataset is `images` without distortion, and the COLMAP model `sparse/0`; every 8th is held out.
"""

import argparse
import math
import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torch.nn import functional
from torch.nn.utils.rnn import pack_sequence

TILE = 16  # pixels along a side of a tile
Y, X = torch.cartesian_prod(torch.arange(TILE) + 0.5, torch.arange(TILE) + 0.5).T  # pixel centres
Y0 = 0.5 / math.sqrt(math.pi)
# A Gaussian is a row p of 59 numbers: mean, sh_dc, sh_rest, opacity logit, log scales, quaternion.
COLUMNS = [3, 3, 45, 1, 3, 4]
# The rates of the paper, times 3, for scales times 6. Those of the mean are in scene extents.
RATES = [0.0, 7.5e-3, 3.75e-4, 0.05, 0.03, 3e-3]
MEANS_FIRST, MEANS_LAST = 4.8e-4, 1.6e-5


class View(NamedTuple):  # camera.md: a photo and its camera
    photo: Tensor  # (3, H, W), 0 to 1
    pose: Tensor  # (3, 4): [W | t]
    f: Tensor  # (2,), focal lengths in pixels
    c: Tensor  # (2,), principal point in pixels


def read_dataset(folder: Path, width: int) -> tuple[list[View], Tensor, Tensor]:
    """structure-from-motion.md: photos of at most `width` pixels, points (N, 3), and colours."""

    def records(name, head):
        """The head of each record of a file, and the file, for what follows the head."""
        with open(folder / "sparse" / "0" / name, "rb") as file:
            for _ in range(*struct.unpack("<Q", file.read(8))):
                yield struct.unpack("<" + head, file.read(struct.calcsize("<" + head))), file

    cameras, views, points = {}, {}, []
    for (key, model, w, h), file in records("cameras.bin", "iiQQ"):
        assert model in (0, 1), "the photos are distorted"  # SIMPLE_PINHOLE, PINHOLE
        *f, cx, cy = struct.unpack(f"<{3 + model}d", file.read(24 + 8 * model))
        cameras[key] = w, h, torch.tensor([f[0], f[-1]]), torch.tensor([cx, cy])
    for (_, *quat, x, y, z, key), file in records("images.bin", "i7di"):
        name = b"".join(iter(lambda file=file: file.read(1), b"\0")).decode()
        file.seek(24 * struct.unpack("<Q", file.read(8))[0], 1)
        w, h, f, c = cameras[key]
        photo = Image.open(folder / "images" / name).convert("RGB")
        photo = photo.resize((min(width, w), round(h * min(1, width / w))), Image.Resampling.BOX)
        scale = torch.tensor([photo.width / w, photo.height / h])
        pose = torch.cat([rotation(torch.tensor([quat]))[0], torch.tensor([[x], [y], [z]])], dim=1)
        pixels = torch.tensor(np.array(photo)).permute(2, 0, 1) / 255
        views[name] = View(pixels, pose, f * scale, c * scale)
    for (_, *point, _, length), file in records("points3D.bin", "Q3d3BdQ"):
        file.seek(8 * length, 1)
        points.append(point)
    xyz, rgb = torch.tensor(points).split(3, dim=1)
    return [views[name] for name in sorted(views)], xyz, rgb / 255


def rotation(quats: Tensor) -> Tensor:
    """Exercise 2, covariance.md: R (N, 3, 3) of quaternions (N, 4) wxyz of any length."""
    w, x, y, z = functional.normalize(quats).unbind(dim=1)
    R1 = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]
    R2 = [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]
    R3 = [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    return torch.stack(R1 + R2 + R3, dim=1).reshape(-1, 3, 3)


def sh_basis(directions: Tensor) -> Tensor:
    """Exercise 5, spherical-harmonics.md: the functions of the degrees 0 to 2, (N, 9)."""
    x, y, z = directions.unbind(dim=1)
    linear = math.sqrt(3 / (4 * math.pi)) * torch.stack([-y, z, -x])
    functions = [x * y, -y * z, (3 * z * z - 1) / math.sqrt(12), -x * z, (x * x - y * y) / 2]
    quadratic = math.sqrt(15 / (4 * math.pi)) * torch.stack(functions)
    return torch.cat([torch.full((1, len(x)), Y0), linear, quadratic]).T


def project(p: Tensor, view: View, degree: int) -> tuple[Tensor, ...]:
    """Exercises 1, 3, 4, projection.md: the splats of the M visible Gaussians.

    Their rows (M,), centres m (M, 2), conics (M, 3), ln o, colours, depths, half boxes (M, 2).
    """
    W, t = view.pose[:, :3], view.pose[:, 3]
    rows = (p.detach()[:, :3] @ W[2] + t[2] > 0.2).nonzero()[:, 0]  # in front of the camera
    mean, sh_dc, sh_rest, logit, log_scales, quats = p[rows].split(COLUMNS, dim=1)
    x_y, z = (mean @ W.T + t).split([2, 1], dim=1)

    # Σ' = J W Σ Wᵀ Jᵀ + 0.3 I = U Uᵀ + 0.3 I with U = J W R S. J is that of a point in the image,
    # or not far outside.
    size = torch.tensor(view.photo.shape[:0:-1])
    near = (view.f * x_y / z).clamp(-view.c - 0.15 * size, 1.15 * size - view.c)
    J = torch.cat([torch.diag_embed(view.f / z), (-near / z)[:, :, None]], dim=2)
    U = J @ W @ (rotation(quats) * log_scales.exp()[:, None, :])
    (a, b), (_, c) = (U @ U.mT + 0.3 * torch.eye(2)).permute(1, 2, 0)
    conics = torch.stack([c, -b, a], dim=1) / (a * c - b * b)[:, None]

    v = functional.normalize(mean + W.T @ t)  # the camera is at −Wᵀ t
    h = torch.cat([sh_dc[:, :, None], sh_rest.reshape(-1, 3, 15)], dim=2)[:, :, : (degree + 1) ** 2]
    colors = 0.5 + torch.einsum("nk,nck->nc", sh_basis(v)[:, : h.shape[2]], h)
    log_o = functional.logsigmoid(logit[:, 0])
    with torch.no_grad():  # outside of the box, α < 1/255
        radius = (2 * (log_o + math.log(255)).clamp(min=0)).sqrt()
        half = torch.stack([a, c], dim=1).sqrt() * radius[:, None]
    m = view.f * x_y / z + view.c
    return rows, m, conics, log_o, colors.clamp(min=0), z[:, 0].detach(), half


def instances(m: Tensor, half: Tensor, depths: Tensor, columns: int, lines: int) -> dict:
    """Exercise 8, rasterizer.md: the splats of each tile that has any, from front to back."""
    order, tiles = depths.argsort(stable=True), {}
    low, high = (m - half - TILE + 0.5)[order], (m + half - 0.5)[order]
    for line in range(lines):
        band = ((low[:, 1] <= TILE * line) & (high[:, 1] >= TILE * line)).nonzero()[:, 0]
        left, right, splats = low[band, 0], high[band, 0], order[band]
        for column in range(columns):
            inside = (left <= TILE * column) & (right >= TILE * column)
            tiles[line * columns + column] = splats[inside]
    return {tile: splats for tile, splats in tiles.items() if len(splats)}


class Blend(torch.autograd.Function):
    """Exercises 6 and 7, blending.md and gradients.md: layer after layer, from front to back."""

    @staticmethod
    def layers(log_alpha, colors, sizes):
        """Yields each layer: its pairs, n; w = T α (n, pixels), α, and the colours (3, n, 1)."""
        T = torch.ones(sizes[0], TILE**2)
        is_open = torch.ones(sizes[0], TILE**2, dtype=torch.bool)
        start = 0
        for n in sizes:
            pairs = slice(start, start + n)
            alpha = log_alpha[pairs].exp().clamp(max=0.99)
            is_open[:n] &= T[:n] * (1 - alpha) >= 1e-4
            alpha *= is_open[:n] & (alpha >= 1 / 255)
            w = T[:n] * alpha
            T[:n] -= w
            yield pairs, n, w, alpha, colors[pairs].T[:, :, None]
            start += n

    @staticmethod
    def forward(ctx, log_alpha, colors, sizes):
        """The tiles (3, tiles, pixels) over black, from ln α (I, pixels) and colours (I, 3)."""
        image = torch.zeros(3, sizes[0], TILE**2)
        for _, n, w, _, c in Blend.layers(log_alpha, colors, sizes):
            image[:, :n] += w * c
        ctx.save_for_backward(log_alpha, colors, image)
        ctx.sizes = sizes
        return image

    @staticmethod
    def backward(ctx, g):
        """q = ∂L/∂ ln α = w gᵀc − α S / (1 − α), where S is what the splats behind add."""
        log_alpha, colors, image = ctx.saved_tensors
        of_log_alpha, of_colors = torch.zeros_like(log_alpha), torch.zeros_like(colors)
        S = (g * image).sum(dim=0)
        for pairs, n, w, alpha, c in Blend.layers(log_alpha, colors, ctx.sizes):
            of_colors[pairs] = (g[:, :n] * w).sum(dim=2).T
            own = w * (g[:, :n] * c).sum(dim=0)
            S[:n] -= own
            of_log_alpha[pairs] = (own - S[:n] * alpha / (1 - alpha)) * (alpha < 0.99)
        return of_log_alpha, of_colors, None


def render(p: Tensor, view: View, degree: int = 2) -> tuple[Tensor, Tensor, Tensor]:
    """reference.md: the image (3, H, W), and rows (M,) and centres (M, 2) of the visible splats."""
    rows, m, conics, log_o, colors, depths, half = project(p, view, degree)
    _, height, width = view.photo.shape
    columns, lines = -(-width // TILE), -(-height // TILE)
    lists = instances(m.detach(), half, depths, columns, lines)
    # Layer k: the k-th splats of all tiles with so many, the tile with most splats first.
    layers = pack_sequence(list(lists.values()), enforce_sorted=False)
    splats, sizes = layers.data, layers.batch_sizes.tolist()
    order = torch.tensor(list(lists))[layers.sorted_indices]
    tiles = torch.cat([order[:n] for n in sizes])

    # ln α = ln o − ½ dᵀ K d, a polynomial of the pixel in its tile, has six coefficients.
    a, b, c = conics[splats].T
    x, y = (m[splats] - TILE * torch.stack([tiles % columns, tiles // columns], dim=1)).T
    constant = log_o[splats] - (a * x * x + c * y * y) / 2 - b * x * y
    terms = torch.stack([constant, a * x + b * y, b * x + c * y, -a / 2, -b, -c / 2], dim=1)
    log_alpha = terms @ torch.stack([torch.ones_like(X), X, Y, X * X, X * Y, Y * Y])

    image = torch.zeros(3, lines * columns, TILE**2)
    image[:, order] = Blend.apply(log_alpha, colors[splats], sizes)
    image = image.reshape(3, lines, columns, TILE, TILE).transpose(2, 3)
    return image.reshape(3, lines * TILE, -1)[:, :height, :width], rows, m


def loss_of(C: Tensor, P: Tensor) -> Tensor:
    """optimisation.md: L = 0.8 mean |C − P| + 0.2 (1 − SSIM)."""
    sides = ((torch.arange(n)[:, None] - torch.arange(n)).abs() for n in C.shape[1:])
    windows = [torch.exp(-(d**2) / 4.5) * (d <= 5) / 3.759233 for d in sides]  # σ = 1.5, 11 pixels
    maps = windows[0] @ torch.cat([C, P, C * C, P * P, C * P]) @ windows[1]
    mu_C, mu_P, CC, PP, CP = maps.split(3)
    above = (2 * mu_C * mu_P + 0.01**2) * (2 * (CP - mu_C * mu_P) + 0.03**2)
    below = (mu_C**2 + mu_P**2 + 0.01**2) * (CC - mu_C**2 + PP - mu_P**2 + 0.03**2)
    return 0.8 * (C - P).abs().mean() + 0.2 * (1 - (above / below).mean())


def first_gaussians(points: Tensor, colors: Tensor) -> Tensor:
    """Exercise 9, optimisation.md: a ball for each point; σ: the mean of 3 nearest distances."""
    blocks = [torch.cdist(part, points).topk(4, largest=False)[0] for part in points.split(512)]
    n, distances = len(points), torch.cat(blocks)[:, 1:].mean(dim=1, keepdim=True)
    sh = (colors - 0.5) / Y0, torch.zeros(n, 45)  # c = ½ + Y₀ h₀
    shape = distances.clamp(min=1e-7).log().repeat(1, 3), torch.eye(1, 4).repeat(n, 1)
    return torch.cat([points, *sh, torch.full((n, 1), 0.1).logit(), *shape], dim=1)


def adam(p: Tensor, g: Tensor, m: Tensor, v: Tensor, step: int, rate: Tensor) -> None:
    """Exercise 9, optimisation.md: a step of Adam, in place."""
    m.mul_(0.9).add_(g, alpha=0.1)
    v.mul_(0.999).addcmul_(g, g, value=0.001)
    p -= rate * (m / (1 - 0.9**step)) / ((v / (1 - 0.999**step)).sqrt() + 1e-15)


def refine(p: Tensor, tau: Tensor, small: float, limit: int) -> tuple[Tensor, Tensor, int]:
    """Exercise 10, density-control.md: also returns the old row of each new one, the kept first."""
    _, _, _, logit, log_scales, _ = p.split(COLUMNS, dim=1)
    alive = logit[:, 0].sigmoid() >= 0.005
    dense = alive & (tau > 2e-4)
    dense[tau.argsort(descending=True)[max(0, limit - int(alive.sum())) :]] = False
    split = dense & (log_scales.exp().amax(dim=1) > small)
    kept, clones, parents = (r.nonzero()[:, 0] for r in (alive & ~split, dense & ~split, split))
    rows = torch.cat([kept, clones, parents, parents])
    p = p[rows]
    mean, _, _, _, log_scales, quats = p[len(kept) + len(clones) :].split(COLUMNS, dim=1)
    mean += (rotation(quats) @ (log_scales.exp() * torch.randn_like(mean))[:, :, None])[:, :, 0]
    log_scales -= math.log(1.6)
    return p, rows, len(kept)


def train(views: list[View], p: Tensor, steps: int, limit: int) -> tuple[Tensor, list[float]]:
    """equations.md, Algorithm 1: the trained Gaussians, and the loss of each step."""
    positions = torch.stack([-v.pose[:, :3].T @ v.pose[:, 3] for v in views])
    extent = 1.1 * float((positions - positions.mean(dim=0)).norm(dim=1).max())
    rates = torch.tensor(RATES).repeat_interleave(torch.tensor(COLUMNS))
    m, v, (total, visits) = torch.zeros_like(p), torch.zeros_like(p), torch.zeros(2, len(p))
    small = [View(functional.avg_pool2d(v.photo, 2), v.pose, v.f / 2, v.c / 2) for v in views]
    losses, queue = [], []
    for step in range(1, steps + 1):
        queue = queue or torch.randperm(len(views)).tolist()
        view = (small if step < 0.4 * steps else views)[queue.pop()]
        leaf = p.clone().requires_grad_()
        image, rows, means2d = render(leaf, view, degree=min(2, 5 * step // steps))
        means2d.retain_grad()
        loss = loss_of(image, view.photo)
        loss.backward()
        losses.append(loss.item())
        rates[:3] = extent * MEANS_FIRST ** (1 - step / steps) * MEANS_LAST ** (step / steps)
        adam(p, leaf.grad, m, v, step, rates)
        total[rows] += (means2d.grad * torch.tensor(view.photo.shape[:0:-1]) / 2).norm(dim=1)
        visits[rows] += 1
        if step % max(1, steps // 12) == 0 and step <= steps // 2:
            p, old, kept = refine(p, total / visits.clamp(min=1), 0.01 * extent, limit)
            m, v, (total, visits) = m[old], v[old], torch.zeros(2, len(p))
            m[kept:], v[kept:] = 0, 0
        if step % 50 == 0:
            print(f"step {step}: loss {losses[-1]:.4f}, {len(p):,} Gaussians", flush=True)
    return p, losses


def write_ply(path: Path, p: Tensor) -> None:
    """ply.md: the rows, with three normals that are 0."""
    names = [*"xyz", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(45)] + ["opacity", "scale_0", "scale_1", "scale_2"]
    names += ["rot_0", "rot_1", "rot_2", "rot_3"]
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(p)}\n"
    header += "".join(f"property float {name}\n" for name in names) + "end_header\n"
    table = torch.cat([p[:, :3], torch.zeros(len(p), 3), p[:, 3:]], dim=1)
    path.write_bytes(header.encode() + table.numpy().astype("<f4").tobytes())


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("dataset", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path("nano.ply"))
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--width", type=int, default=326, help="of the photos, in pixels")
    parser.add_argument("--limit", type=int, default=40_000, help="of Gaussians")
    options = parser.parse_args()
    torch.manual_seed(0)
    views, points, colors = read_dataset(options.dataset, options.width)
    photos = [view for i, view in enumerate(views) if i % 8]
    p, _ = train(photos, first_gaussians(points, colors), options.steps, options.limit)
    with torch.no_grad():
        errors = [(render(p, v)[0].clamp(0, 1) - v.photo).square().mean() for v in views[::8]]
    print(f"PSNR of the held-out photos: {-10 * torch.stack(errors).log10().mean():.2f} dB")
    write_ply(options.output, p)
