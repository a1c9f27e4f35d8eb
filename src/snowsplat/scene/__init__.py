"""Cameras, Gaussians, rendering, and operations on a scene."""
