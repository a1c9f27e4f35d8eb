"""The errors that a user can fix, in one line."""


class UserError(Exception):
    """An error with a one-line message: what is wrong, and what to do.

    The command line prints the message and exits with status 2. Settings inside the message are in
    backquotes, "use `overwrite` to replace it"; the command line prints their flags instead.
    """


def message_of(error: OSError, cause: str | None = None) -> str:
    """An error of the system in one line: the file, and what is wrong.

    ``cause``: what is named in place of the file.
    """
    where = f"{cause or error.filename}: " if error.filename else ""
    return f"{where}{error.strerror or error}"


class SettingError(UserError):
    """A value that a setting cannot have: ``"<setting>: <what is wrong>; <what to do>"``.

    Attributes:
        setting: name of the argument or field in Python, such as ``lr_means``. The command line
            prints its flag in its place, ``--lr-means``.
        problem: the rest of the message.
    """

    def __init__(self, setting: str, problem: str) -> None:
        super().__init__(f"{setting}: {problem}")
        self.setting = setting
        self.problem = problem
