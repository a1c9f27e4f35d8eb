"""The number of steps, the size of the photos and the number of Gaussians for a budget."""
