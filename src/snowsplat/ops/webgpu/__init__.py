"""The device "webgpu": tensors and native functions on any GPU with Vulkan, Metal or Direct3D 12.

`tensor` makes the device known to torch, `memory` keeps the content of tensors, and `launches` runs
the kernels in `native/wgsl`. The package wgpu is imported when the device is used.
"""

from snowsplat.util.native_layout import Fields

__all__ = ["launch"]


def launch(name: str, fields: Fields) -> int:
    """Calls a native function with tensors on this device; see `ops.native.launch`."""
    from snowsplat.ops.webgpu import launches

    return launches.launch(name, fields)
