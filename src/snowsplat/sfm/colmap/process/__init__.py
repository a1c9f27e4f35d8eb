"""The process in which COLMAP runs, and what it sends to its parent."""
