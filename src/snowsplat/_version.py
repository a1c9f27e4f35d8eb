"""The version of the package. `snowsplat.__version__` is the public name."""

__version__ = "0.3.0"
