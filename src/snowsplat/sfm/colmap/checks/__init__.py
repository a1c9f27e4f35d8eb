"""Whether a model agrees with its matches; its repair, and why a photo has no pose."""
