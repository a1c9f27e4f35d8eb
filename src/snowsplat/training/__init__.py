"""Optimise Gaussians so that they reproduce the photos of a dataset."""
