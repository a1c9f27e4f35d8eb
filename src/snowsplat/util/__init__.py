"""Helpers without knowledge of Gaussians: files, errors, JSON, processes, HTML."""
