"""The errors that a user can fix, in one line."""

from typing import Any

from snowsplat.util.messages import Message, as_message, message


class _WithMessage(Exception):
    def __init__(self, key: str | Message, /, **values: Any) -> None:
        self.message = message(key, **values) if isinstance(key, str) else key
        super().__init__(self.message)

    def __str__(self) -> str:
        return str(self.message)


class UserError(_WithMessage):
    """An error with a one-line message: what is wrong, and what to do.

        raise UserError("{path}: is a file; use a folder", path=path)

    The command line prints the message and exits with status 2. Settings inside the message are in
    backquotes, "use `overwrite` to replace it"; the command line prints their flags instead.

    Attributes:
        message: the key and its values, see `Message`.
    """


#: What systems say of files, as `cause_of` finds it.
SYSTEM_ERRORS = (
    message("No such file or directory"),
    message("Not a directory"),
    message("Permission denied"),
    message("No space left on device"),
    message("Read-only file system"),
    message("Input/output error"),
)


def cause_of(error: Exception) -> Message:
    """What is wrong, without the file that an error of the system names."""
    return as_message(getattr(error, "strerror", None) or error)


def message_of(error: UserError | OSError, cause: str | None = None) -> Message:
    """An error in one line; of the system: the file, and what is wrong.

    ``cause``: what is named in place of the file.
    """
    if isinstance(error, UserError):
        return error.message
    if not error.filename:
        return cause_of(error)
    return message("{file}: {error}", file=cause or error.filename, error=cause_of(error))


class SettingError(UserError):
    """A value that a setting cannot have: ``"<setting>: <what is wrong>; <what to do>"``.

    Attributes:
        setting: name of the argument or field in Python, such as ``lr_means``. The command line
            prints its flag in its place, ``--lr-means``.
        problem: the rest of the message.
    """

    def __init__(self, setting: str, problem: str | Message, /, **values: Any) -> None:
        self.setting = setting
        self.problem = message(problem, **values) if isinstance(problem, str) else problem
        super().__init__(message("{setting}: {problem}", setting=setting, problem=self.problem))
        self.args = (setting, self.problem)  # by which pickle makes the error again


class Problem(_WithMessage, ValueError):
    """What is wrong with a value, a file or a part of one; who catches it says with which.

    Attributes:
        message: see `UserError`.
    """
