"""Lenses: from the pixels of a photo to those of a camera without distortion."""
