"""Looking at scenes in a browser: `network` while they are trained, the static one afterwards."""
