"""Conversion between world frames that differ only in the signs of their axes.

`Similarity` handles any rotation; this module only changes signs, which is exact. It converts the
frame of a format to ours and back. Arrays are NumPy, float32, one row per Gaussian.
"""

import numpy as np

#: Signs that convert between x right, y down, z forward (our frame, and that of most scene files)
#: and x right, y up, z back (OpenGL, three.js, glTF), in both directions.
UP_BACK = (1, -1, -1)


def flip_axes(
    means: np.ndarray, quats: np.ndarray, sh_rest: np.ndarray, signs: tuple[int, int, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Multiply each axis by its sign, ±1: positions (N, 3), quaternions wxyz (N, 4), SH (N, K, 3).

    A rotation R becomes M R M, where M is the diagonal matrix of the signs. That is a rotation
    again, even if M is a reflection.
    """
    x, y, z = signs
    quat_signs = (1, y * z, x * z, x * y)
    # The sign change of each real spherical harmonic: up to even polynomials, they are products of
    # x, y, z in the order y z x | xy yz 1 xz 1 | y xyz y z x z x.
    sh_signs = (y, z, x, x * y, y * z, 1, x * z, 1, y, x * y * z, y, z, x, z, x)
    return (
        means * np.array(signs, np.float32),
        quats * np.array(quat_signs, np.float32),
        sh_rest * np.array(sh_signs[: sh_rest.shape[1]], np.float32)[:, None],
    )
