"""A photo as 2D Gaussians: fitting them, and the files that contain them."""
