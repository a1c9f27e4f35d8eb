"""3D Gaussian Splatting that runs on any computer."""

__version__ = "0.1.0"
