"""Camera models: which lens the photos have, and how many focal lengths."""
