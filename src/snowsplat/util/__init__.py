"""Helpers that do not depend on Gaussians: files, errors, JSON, processes, HTML."""
