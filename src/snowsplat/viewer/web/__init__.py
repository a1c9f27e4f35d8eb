"""View a finished scene in the browser: the page, its server, and the page as a single file."""
