"""ICC profiles for tests, and photos that have them."""

import struct

import numpy as np

DISPLAY_P3 = ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060))
PROPHOTO = ((0.7347, 0.2653), (0.1596, 0.8404), (0.0366, 0.0001))
_D65, _D50 = np.array([0.9505, 1.0, 1.089]), np.array([0.9642, 1.0, 0.8249])
_BRADFORD = np.array(
    [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
)


def to_xyz(primaries) -> np.ndarray:
    """(3, 3): linear RGB to XYZ of the illuminant D50, for a white point of D65."""
    columns = np.array([[x / y, 1, (1 - x - y) / y] for x, y in primaries]).T
    matrix = columns * np.linalg.solve(columns, _D65)
    adapt = np.diag(_BRADFORD @ _D50 / (_BRADFORD @ _D65))
    return np.linalg.inv(_BRADFORD) @ adapt @ _BRADFORD @ matrix


def colour_profile(primaries, gamma: float) -> bytes:
    """The profile of an RGB colour space."""
    columns = to_xyz(primaries).T
    tags = {f"{name}XYZ": _xyz(column) for name, column in zip("rgb", columns, strict=True)}
    return _packed("RGB ", tags | {f"{name}TRC": _gamma(gamma) for name in "rgb"})


def grey_profile(gamma: float) -> bytes:
    return _packed("GRAY", {"kTRC": _gamma(gamma)})


def cmyk_profile(darkest: float) -> bytes:
    """A profile in which ink multiplies the light; full black ink leaves ``darkest`` of it."""
    grid = np.stack(np.meshgrid(*[[0.0, 1.0]] * 4, indexing="ij"), axis=-1).reshape(-1, 4)
    light = 1 - (1 - darkest) * np.minimum(1, grid.sum(1) / 4)  # L* falls with the ink
    lab = np.stack([light * 255, np.full(16, 128), np.full(16, 128)], axis=1)
    identity = np.tile(np.arange(256), 7).astype(np.uint8)
    table = struct.pack(">4s4x4B", b"mft1", 4, 3, 2, 0)
    table += b"".join(struct.pack(">i", round(65536 * v)) for v in np.eye(3).ravel())
    table += identity[: 4 * 256].tobytes() + np.rint(lab).astype(np.uint8).tobytes()
    return _packed("CMYK", {"A2B0": table + identity[: 3 * 256].tobytes()}, "Lab ")


def _xyz(values) -> bytes:
    return b"XYZ \0\0\0\0" + b"".join(struct.pack(">i", round(65536 * v)) for v in values)


def _gamma(gamma: float) -> bytes:
    return b"curv\0\0\0\0" + struct.pack(">IHH", 1, round(gamma * 256), 0)


def _packed(space: str, tags: dict[str, bytes], connection: str = "XYZ ") -> bytes:
    tags = {"wtpt": _xyz(_D50), **tags}
    table, body, start = b"", b"", 132 + 12 * len(tags)
    for name, data in tags.items():
        table += struct.pack(">4sII", name.encode(), start + len(body), len(data))
        body += data
    kind = b"prtr" if space == "CMYK" else b"mntr"
    head = struct.pack(">I4xI4s", start + len(body), 0x02400000, kind)
    head += space.encode() + connection.encode() + bytes(12) + b"acsp"
    head = head.ljust(68, b"\0") + _xyz(_D50)[8:]
    return head.ljust(128, b"\0") + struct.pack(">I", len(tags)) + table + body
