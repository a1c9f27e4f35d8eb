"""Chooses pairs of photos, and finds their matches."""
