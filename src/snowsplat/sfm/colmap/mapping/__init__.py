"""Makes models (camera poses and points) from matches."""
