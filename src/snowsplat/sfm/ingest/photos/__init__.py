"""Reads photos with their metadata and masks, and copies them to input/."""
