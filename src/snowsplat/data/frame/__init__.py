"""The frame of a dataset: its box, its near plane, its origin, and its level, north and scale."""
