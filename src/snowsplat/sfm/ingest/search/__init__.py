"""Finds photos and videos in folders and archives, each picture once."""
