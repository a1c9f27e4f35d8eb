"""The command line: one short file a verb, which parses, calls and prints.

At import these modules take the standard library, tyro and rich only; torch comes in when a verb
runs, so that `--help` and mistakes in flags answer at once.
"""
