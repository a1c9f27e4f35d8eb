"""The options of the functions of `snowsplat.pipeline`: what one can set, and the flags for it.

These modules import neither torch nor numpy, so that the command line can show and check the
options before it loads what computes.
"""
