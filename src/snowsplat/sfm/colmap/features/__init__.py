"""Detects features, and moves them to their exact positions in the final model."""
