"""The command line: one short file per subcommand, which parses, calls `pipeline`, and prints.

These modules import only the standard library, tyro and rich. torch is imported when a subcommand
runs, so `--help` and errors in flags do not wait for it.
"""
