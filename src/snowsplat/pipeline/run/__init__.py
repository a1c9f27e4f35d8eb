"""A training in an output folder: its processes, checkpoints, limits and results."""
