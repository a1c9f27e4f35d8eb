"""View finished scenes in a browser: the page, a server for it, and the page as a single file."""
