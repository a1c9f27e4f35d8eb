"""Python functions that do the work of the subcommands.

Each function takes paths and options and returns a result or raises a
`snowsplat.util.errors.UserError`. None of them prints: progress goes to an `Observer`.
"""
