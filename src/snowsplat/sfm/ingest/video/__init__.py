"""Reads videos, and writes their sharpest frames to input/."""
