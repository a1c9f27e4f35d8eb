"""Train within a given time: choose the settings, then keep the pace."""
