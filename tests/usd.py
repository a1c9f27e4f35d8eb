"""Whether OpenUSD, an optional package, is installed; without it, USD files are left out."""

try:
    from pxr import UsdVol

    USD = hasattr(UsdVol, "ParticleField3DGaussianSplat")
except ImportError:
    USD = False
