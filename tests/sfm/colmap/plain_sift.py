"""SIFT (Lowe, IJCV 2004) in plain NumPy and float64: the reference of `sift.detect_in_grey`."""

import numpy as np

LAYERS, SIGMA, BORDER, STEPS = 3, 1.6, 5, 5
CONTRAST, EDGE = 0.02 * 255 / LAYERS, 10


def features(grey):
    """All features of a grey image (H, W) uint8, the largest first: keypoints (N, 6), and RootSIFT
    descriptors (N, 128)."""
    found = []
    for octave, levels in enumerate(octaves(grey)):
        pixel = 0.5 * 2**octave
        for layer, row, column, offset in sorted(set(extrema(levels))):
            scale = SIGMA * 2 ** ((layer + offset[0]) / LAYERS)
            x, y = (column + offset[2]) * pixel + 0.5, (row + offset[1]) * pixel + 0.5
            for turns in orientations(levels[layer], row, column, scale):
                a, s = -2 * np.pi * turns, scale * pixel
                shape = (s * np.cos(a), -s * np.sin(a), s * np.sin(a), s * np.cos(a))
                values = descriptor(levels[layer], row, column, scale, turns)
                found.append(((-s, y, x), (x, y, *shape), values))
    found.sort(key=lambda feature: feature[0])
    keypoints = np.array([keypoint for _, keypoint, _ in found]).reshape(-1, 6)
    return keypoints, np.array([values for *_, values in found]).reshape(-1, 128)


def octaves(grey):
    """The levels of blur (6, h, w) of each octave. The first has twice the size of the image."""
    height, width = grey.shape
    padded = np.pad(grey.astype(float), ((0, 1), (0, 1)), "edge")
    base = np.empty((2 * height, 2 * width))
    for i in (0, 1):
        for j in (0, 1):
            corners = [padded[a : a + height, b : b + width] for a in (0, i) for b in (0, j)]
            base[i::2, j::2] = sum(corners) / 4
    base = blurred(base, np.sqrt(SIGMA**2 - 1))  # the image has a blur of 0.5 pixels
    while min(base.shape) > 2 * BORDER:
        levels = [base]
        for i in range(1, LAYERS + 3):
            before, after = SIGMA * 2 ** ((i - 1) / LAYERS), SIGMA * 2 ** (i / LAYERS)
            levels.append(blurred(levels[-1], np.sqrt(after**2 - before**2)))
        yield np.stack(levels)
        height, width = base.shape
        base = levels[LAYERS][: height // 2 * 2 : 2, : width // 2 * 2 : 2]


def blurred(image, sigma):
    radius = (round(8 * sigma + 1) | 1) // 2
    at = np.arange(-radius, radius + 1)
    weights = np.exp(-(at**2) / (2 * sigma**2))
    weights /= weights.sum()
    for axis in (0, 1):
        margin = [(radius, radius) if axis == i else (0, 0) for i in (0, 1)]
        padded = np.pad(image, margin, "reflect")
        image = sum(
            w * np.take(padded, np.arange(i, i + image.shape[axis]), axis)
            for i, w in enumerate(weights)
        )
    return image


def extrema(levels):
    """(layer, row, column, offset) of the extrema of the differences of Gaussians."""
    differences = np.diff(levels, axis=0)
    windows = np.lib.stride_tricks.sliding_window_view(differences, (3, 3, 3))
    middle = differences[1:-1, 1:-1, 1:-1]
    largest = (middle >= windows.max((3, 4, 5))) & (middle > CONTRAST / 2)
    smallest = (middle <= windows.min((3, 4, 5))) & (middle < -CONTRAST / 2)
    for place in np.argwhere(largest | smallest) + 1:
        for _ in range(STEPS):
            if not inside(place, differences.shape):
                break
            layer, row, column = place
            d = differences[layer - 1 : layer + 2, row - 1 : row + 2, column - 1 : column + 2]
            gradient, hessian = derivatives(d)
            offset = -np.linalg.solve(hessian, gradient)
            if np.abs(offset).max() < 0.5:
                contrast = d[1, 1, 1] + gradient @ offset / 2
                trace, product = np.trace(hessian[1:, 1:]), np.linalg.det(hessian[1:, 1:])
                if abs(contrast) >= CONTRAST and EDGE * trace**2 < (EDGE + 1) ** 2 * product:
                    yield int(layer), int(row), int(column), tuple(offset)
                break
            if np.abs(offset).max() >= 2.5:
                break
            place = place + np.rint(offset).astype(int)


def inside(place, shape):
    return 1 <= place[0] <= LAYERS and all(
        BORDER <= i < n - BORDER for i, n in zip(place[1:], shape[1:], strict=True)
    )


def derivatives(d):
    """The gradient (3,) and the Hessian matrix (3, 3) in the middle of (3, 3, 3) values."""
    steps = np.eye(3, dtype=int)

    def at(*moves):
        return d[tuple(1 + sum(moves))]

    gradient = np.array([(at(s) - at(-s)) / 2 for s in steps])
    hessian = np.diag([at(s) + at(-s) - 2 * d[1, 1, 1] for s in steps])
    for i, j in ((0, 1), (0, 2), (1, 2)):
        s, t = steps[i], steps[j]
        hessian[i, j] = hessian[j, i] = (at(s, t) - at(s, -t) - at(-s, t) + at(-s, -t)) / 4
    return gradient, hessian


def around(level, row, column, radius):
    """Of the pixels that have four neighbours: rows and columns from (row, column); the direction
    of the gradient, counterclockwise in turns, and its length."""
    rows, columns = np.mgrid[-radius : radius + 1, -radius : radius + 1].reshape(2, -1)
    y, x = row + rows, column + columns
    used = (y > 0) & (y < level.shape[0] - 1) & (x > 0) & (x < level.shape[1] - 1)
    rows, columns, y, x = rows[used], columns[used], y[used], x[used]
    across, up = level[y, x + 1] - level[y, x - 1], level[y - 1, x] - level[y + 1, x]
    return rows, columns, np.arctan2(up, across) / (2 * np.pi) % 1, np.hypot(across, up)


def orientations(level, row, column, scale):
    """The directions of the gradients in turns: peaks of their histogram."""
    rows, columns, turns, length = around(level, row, column, round(4.5 * scale))
    weights = np.exp(-(rows**2 + columns**2) / (2 * (1.5 * scale) ** 2))
    bins = np.bincount(np.rint(36 * turns).astype(int) % 36, weights * length, 36)
    smooth = sum(w * np.roll(bins, i) for i, w in enumerate((1, 4, 6, 4, 1), -2)) / 16
    left, right = np.roll(smooth, 1), np.roll(smooth, -1)
    peaks = (smooth > left) & (smooth > right) & (smooth >= 0.8 * smooth.max())
    for i in np.flatnonzero(peaks):
        yield (i + 0.5 * (left[i] - right[i]) / (left[i] - 2 * smooth[i] + right[i])) / 36


def descriptor(level, row, column, scale, turns):
    """The square roots (128,) of a normalised histogram, times 512."""
    radius = round(3 * scale * np.sqrt(2) * 2.5)
    rows, columns, direction, length = around(level, row, column, radius)
    cos, sin = (f(2 * np.pi * turns) / (3 * scale) for f in (np.cos, np.sin))
    down, across = columns * sin + rows * cos, columns * cos - rows * sin
    weight = length * np.exp(-(down**2 + across**2) / 8)
    histogram = np.zeros((6, 6, 8))
    used = (np.abs(down) < 2.5) & (np.abs(across) < 2.5)
    at = [down[used] + 2.5, across[used] + 2.5, (direction[used] - turns) % 1 * 8]
    whole = [np.floor(a).astype(int) for a in at]
    for corner in np.ndindex(2, 2, 2):
        shares = [np.abs(1 - c - (a - w)) for a, w, c in zip(at, whole, corner, strict=True)]
        index = [w + c for w, c in zip(whole, corner, strict=True)]
        np.add.at(histogram, (index[0], index[1], index[2] % 8), np.prod(shares, 0) * weight[used])
    values = histogram[1:5, 1:5].reshape(-1)
    values = np.minimum(values, 0.2 * np.linalg.norm(values))
    values = np.rint(512 * values / np.linalg.norm(values))
    return np.rint(512 * np.sqrt(values / values.sum()))
