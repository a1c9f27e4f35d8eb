"""Files of COLMAP: sparse models are found, read and written."""
