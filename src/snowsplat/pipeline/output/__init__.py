"""The files of an output folder, and where a scene is read from."""
