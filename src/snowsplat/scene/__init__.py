"""Cameras, Gaussians, and operations on a scene."""
