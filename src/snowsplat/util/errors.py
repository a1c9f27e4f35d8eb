"""The one kind of error that is the user's to mend."""


class UserError(Exception):
    """One line: what is wrong, and what to do about it. The command line exits with 2 after it."""
