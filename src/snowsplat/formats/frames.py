"""From one world frame to another whose axes point the same or the opposite way.

`Similarity` turns scenes in any way; this only changes signs, exactly, which takes a format's
frame to ours and back. Arrays are numpy, float32, one row a Gaussian.
"""

import numpy as np

#: x right, y down, z forward: the house frame, and that of the PLY files of this field.
#: x right, y up, z back: OpenGL, three.js, glTF. These signs take either to the other.
UP_BACK = (1, -1, -1)


def flip_axes(
    means: np.ndarray, quats: np.ndarray, sh_rest: np.ndarray, signs: tuple[int, int, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions (N, 3), quaternions wxyz (N, 4), SH (N, K, 3), each axis times its sign, ± 1.

    The rotation becomes M R M, M the diagonal matrix of the signs: a rotation again, also where
    their number makes a reflection of M.
    """
    x, y, z = signs
    quat_signs = (1, y * z, x * z, x * y)
    # What the sign of each real spherical harmonic does: they are products of x, y, z (and even
    # polynomials of them), in the order y z x | xy yz 1 xz 1 | y xyz y z x z x.
    sh_signs = (y, z, x, x * y, y * z, 1, x * z, 1, y, x * y * z, y, z, x, z, x)
    return (
        means * np.array(signs, np.float32),
        quats * np.array(quat_signs, np.float32),
        sh_rest * np.array(sh_signs[: sh_rest.shape[1]], np.float32)[:, None],
    )
