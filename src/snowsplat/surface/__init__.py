"""Surfaces of a scene: depth maps, their fusion, triangles."""
