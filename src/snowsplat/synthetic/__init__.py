"""Photos of a procedural scene with known poses, for the demo and for end-to-end tests.

The scene is a still life (`still_life`) of shapes (`shapes`) with procedural textures (`textures`).
It is ray traced (`scene`) along a path around it, with lens distortion and sensor noise
(`photographer`).
"""

from snowsplat.synthetic.photographer import Truth, write_synthetic_photos

__all__ = ["Truth", "write_synthetic_photos"]
