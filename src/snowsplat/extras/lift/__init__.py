"""One photo and its depth map as Gaussians: a disc per pixel or per block of pixels."""
