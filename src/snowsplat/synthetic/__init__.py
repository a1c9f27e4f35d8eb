"""Photos of a scene of our own, with known poses: for the demo, and for tests of the whole way.

A still life (`still_life`) of procedurally painted (`textures`) shapes (`shapes`), ray traced
(`scene`) and photographed on a walk around it, with lens distortion and sensor noise
(`photographer`).
"""

from snowsplat.synthetic.photographer import Truth, write_synthetic_photos

__all__ = ["Truth", "write_synthetic_photos"]
