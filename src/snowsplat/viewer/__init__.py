"""View scenes in a browser: `live` during training, `web` for finished scenes."""
