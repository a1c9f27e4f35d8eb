"""The native functions on a GPU."""

from snowsplat.ops.cuda.launches import launch

__all__ = ["launch"]
