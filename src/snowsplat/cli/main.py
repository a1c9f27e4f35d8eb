"""The command `snowsplat`: selects the subcommand, runs it, and reports errors.

Exit codes: 0 success; 2 an error in the flags or the input, reported as one line on stderr;
130 stopped by Ctrl-C, SIGTERM or SIGHUP, with all finished results saved; 141 the reader of the
output has closed it. Any other failure is a defect of the program and shows a traceback.

Characters that the encoding of stdout lacks become "?"; stderr escapes them, so that an error names
its file. Files are not concerned: snowsplat writes all of them in UTF-8.
"""

from __future__ import annotations

import difflib
import errno
import io
import logging
import os
import sys
import warnings
from collections.abc import Sequence
from contextlib import redirect_stderr, suppress
from io import TextIOWrapper
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from snowsplat._version import __version__
from snowsplat.cli.command import next_step
from snowsplat.cli.pages import has_screen
from snowsplat.cli.reference_flags import translated
from snowsplat.cli.subcommands import SUBCOMMANDS, advice, load_subcommand, overview
from snowsplat.util.errors import SettingError, UserError, message_of
from snowsplat.util.flags import with_flags
from snowsplat.util.interrupts import ended_by_signals
from snowsplat.util.messages import Message, as_message, language_of_environment, message, use
from snowsplat.util.own_files import import_own_files
from snowsplat.util.safe_json import printable

if TYPE_CHECKING:
    from snowsplat.cli.command import Command

_REMEDIES = {
    errno.EACCES: message("check the owner and the permissions, or use another folder"),
    errno.EROFS: message("write the result to another folder"),
    errno.ENOSPC: message("free some space, or write the result to another disk"),
}
_OUT_OF_MEMORY = message(
    "out of memory; train with --memory and a smaller number, or use smaller photos, -r 2"
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command with the arguments ``argv`` (default: ``sys.argv[1:]``).

    Returns the exit code.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    accept_all_characters()
    use(language_of_environment())
    _report_log_and_warnings_as_lines()
    if arguments in (["--version"], ["version"]):
        print("snowsplat", __version__)
        return 0
    if arguments[:1] == ["help"]:  # `help train` is `train --help`
        arguments = [*arguments[1:2], "--help"]
    if not arguments and sys.stdout.isatty() and has_screen():
        arguments = ["studio"]
    if arguments in ([], ["-h"], ["--help"]):
        print(overview())
        return 0
    try:
        with ended_by_signals():
            command = parse(arguments)
            from snowsplat.cli.command import run

            return run(command)
    except SettingError as error:
        return _fail(_with_flags(f"`{error.setting}`: {error.problem}", arguments), 2)
    except UserError as error:
        return _fail(_with_flags(str(error), arguments), 2)
    except KeyboardInterrupt:
        return _fail("stopped", 130)
    except BrokenPipeError:  # the reader of the output has closed it, as `| head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141  # 128 + SIGPIPE, as for other programs: the run is not complete
    except MemoryError:
        return _fail(_OUT_OF_MEMORY, 2)
    except RuntimeError as error:
        if not _is_out_of_memory(error):
            raise
        return _fail(_OUT_OF_MEMORY, 2)
    except OSError as error:
        remedy = _REMEDIES.get(error.errno or 0)
        what = message_of(error, _locked_folder(error))
        return _fail(f"{what}; {remedy}" if remedy else what, 2)


def parse(arguments: Sequence[str]) -> Command:
    """The subcommand with the values of its arguments.

    Exits the process, as argparse does, after printing a help text.
    Raises: UserError: an unknown subcommand, or invalid or refused flags.
    """
    name, *rest = arguments
    # The files of `--import` are needed before the other flags are known.
    own = [file for flag, file in pairwise(rest) if flag == "--import"]
    own += [word.removeprefix("--import=") for word in rest if word.startswith("--import=")]
    import_own_files(own)
    if name not in SUBCOMMANDS and not name.startswith("-"):
        raise UserError(_unknown_subcommand(name))
    rest, notes = translated(name, rest)
    for note in notes:
        _print_error(note)
    from snowsplat.cli import parser

    # Importing and analysing all of them takes longer than everything else that a help text needs.
    # Only completion scripts need the flags of all.
    commands = {
        each: load_subcommand(each) if each == name or name.startswith("-") else None
        for each in SUBCOMMANDS
    }
    printed = io.StringIO()
    try:
        with redirect_stderr(printed):
            given = parser.parse(name, rest, commands)
    except SystemExit as ended:
        if not ended.code:
            sys.stderr.write(printed.getvalue())
            raise
        from snowsplat.cli.flag_errors import explained, misplaced

        if name.startswith("-"):
            raise UserError(misplaced(name)) from None
        raise UserError(explained(load_subcommand(name), rest, printed.getvalue())) from None
    command = load_subcommand(name)
    if "config" in given:
        from snowsplat.cli.config_file import with_file

        given = with_file(command, given)
    return command.of(given)


def _with_flags(message: str, arguments: Sequence[str]) -> str:
    """A message with the flags of the subcommand that was called."""
    name = arguments[0]
    return with_flags(message, load_subcommand(name) if name in SUBCOMMANDS else None)


def _unknown_subcommand(name: str) -> Message:
    similar = difflib.get_close_matches(name, [*SUBCOMMANDS], 1)
    hint: Message | str | None = advice(name)
    if hint is None and os.path.exists(name):
        make = next_step(message("to make a scene"), "make", name)
        if _is_scene(name):
            make = next_step(message("to see it"), "view", name)
        hint = message("{make}; {info}", make=make, info=next_step(message("or"), "info", name))
    elif hint is None and similar:
        hint = message("did you mean {name}?", name=similar[0])
    elif hint is None:
        hint = message("choose from {names}", names=[*SUBCOMMANDS])
    return message(
        "{name}: unknown subcommand; {hint} (snowsplat --help describes all of them)",
        name=name,
        hint=hint,
    )


def _is_scene(path: str) -> bool:
    """Whether this is a file of a known format, or a folder with a scene."""
    from snowsplat.formats.registry import format_for_reading
    from snowsplat.project.project import Project

    try:
        scene = Project.open(path).scene
        return scene is not None and format_for_reading(scene) is not None
    except (OSError, UserError):
        return False


def _is_out_of_memory(error: RuntimeError) -> bool:
    """Whether torch ran out of memory; it has an exception class for GPU memory only."""
    text = str(error)
    return any(part in text for part in ("out of memory", "not enough memory", "allocate memory"))


def _locked_folder(error: OSError) -> str | None:
    """The folder that cannot be entered, if this is why a file cannot be found in it."""
    folder = os.path.dirname(str(error.filename)) or "."
    locked = isinstance(error, PermissionError) and not os.access(folder, os.X_OK)
    return folder if locked else None


def _fail(text: object, code: int) -> int:
    _print_error(text)
    return code


def _print_error(text: object) -> None:
    print("snowsplat:", printable(" ".join(str(text).split())), file=sys.stderr)


class _LogHandler(logging.Handler):
    """Prints log records in the same form as errors, in the language of the program."""

    def emit(self, record: logging.LogRecord) -> None:
        record.msg = str(as_message(record.msg))
        _print_error(record.getMessage())


def _report_log_and_warnings_as_lines() -> None:
    def show(text: Warning | str, *_: Any, **__: Any) -> None:
        _print_error(message("warning: {text}", text=text))

    warnings.showwarning = show  # type: ignore[assignment]  # the name of its first argument
    # Pillow warns about each unreadable tag of a damaged photo; snowsplat reports its effect once.
    warnings.filterwarnings("ignore", module=r"PIL\.")
    logger = logging.getLogger("snowsplat")
    if not logger.handlers:
        logger.addHandler(_LogHandler())
        logger.setLevel(logging.INFO)


def accept_all_characters() -> None:
    """Make stdout replace the characters that its encoding lacks, as stderr does."""
    if isinstance(sys.stdout, TextIOWrapper):  # not in all notebooks; None without a terminal
        # Python looks for the position in a file, which a redirected stream may not have.
        with suppress(OSError):
            sys.stdout.reconfigure(errors="replace")
