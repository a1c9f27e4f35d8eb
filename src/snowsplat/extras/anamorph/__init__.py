"""`snowsplat anamorph`: Gaussians that show another picture from each side."""
