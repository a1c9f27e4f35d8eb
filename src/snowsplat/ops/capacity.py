"""`Capacity`: memory allocated on a GPU before the amount that a frame requires is known."""

from dataclasses import dataclass

from torch import Tensor


@dataclass
class Capacity:
    """The number of instances (pairs of a splat and a tile that it touches) that a frame may have.

    Rasterizing needs memory for every instance. The number of instances is computed on the GPU, and
    the CPU would have to wait for it. With a capacity, memory for `instances` instances is
    allocated without waiting, and the GPU writes the number that the frame requires to `required`,
    (1,) int64. If `required` exceeds `instances`, only some of the splats are rasterized. Then the
    image and the gradients are wrong, and the frame has to be repeated with a larger capacity. On
    the CPU the memory always suffices, and `instances` is ignored.
    """

    instances: int
    required: Tensor
