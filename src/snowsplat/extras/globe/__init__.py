"""A scene in a snow globe, which can be shaken: a web page and a video.

A flake is a Gaussian that has come loose.
"""
