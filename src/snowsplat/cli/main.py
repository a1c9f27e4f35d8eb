"""The command `snowsplat`: finds the verb, runs it, turns errors into a line and an exit code.

Exit codes: 0 done; 2 a mistake in the flags or the input, told in one line on stderr; 130 stopped
by Ctrl-C, all that was reached is saved; 141 the reader of our output has gone. Anything else is a
defect of the program, with its traceback.
"""

import inspect
import logging
import os
import sys
import warnings
from collections.abc import Sequence
from typing import Annotated, Any, Union

import tyro

from snowsplat.cli.convert import Convert
from snowsplat.cli.evaluate import Evaluate
from snowsplat.cli.info import Info
from snowsplat.cli.make import Make
from snowsplat.cli.render import Render
from snowsplat.cli.sfm import Sfm
from snowsplat.cli.train import Train
from snowsplat.cli.view import View
from snowsplat.cli.watch import Watch
from snowsplat.util.errors import SettingError, UserError
from snowsplat.util.safe_json import printable

VERBS: dict[str, Any] = {
    "make": Make,
    "sfm": Sfm,
    "train": Train,
    "evaluate": Evaluate,
    "render": Render,
    "view": View,
    "watch": Watch,
    "convert": Convert,
    "info": Info,
}

# Former names of subcommands, still accepted but not listed.
_FORMER_NAMES = {"capture": "sfm"}

DESCRIPTION = """3D Gaussian Splatting on any computer: photos become a scene, shown in real time.

  snowsplat make PHOTOS                     photos or a video -> a scene: all of what follows
  snowsplat sfm PHOTOS -o DATASET           photos or a video -> photos with known cameras
  snowsplat train DATASET -o OUT --eval     photos with known cameras -> a scene in OUT
  snowsplat evaluate OUT                    PSNR, SSIM of the photos held out
  snowsplat render OUT                      pictures of the scene beside the photos
  snowsplat view FILE|OUT                   fly through a scene in the browser
  snowsplat watch OUT                       a scene with its photos, also while it is trained
  snowsplat convert SCENE [MORE …] FILE     another format; cut, thinned out, turned, merged
  snowsplat info ANYTHING                   what is in a scene, a dataset, an output folder

Each has its own help: snowsplat train --help

For completion in the shell, put this into a file that it reads:
  eval "$(snowsplat --tyro-print-completion bash)"    (or zsh)"""


_OUT_OF_MEMORY = (
    "out of memory; train with --memory and a smaller number, or make photos smaller, -r 2"
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command with ``argv`` (those of the process by default); gives its exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    _say_notes_and_warnings_in_one_line()
    try:
        return int(_parse(arguments or ["--help"]).run())
    except SettingError as error:
        return _fail(f"--{error.setting.replace('_', '-')}: {error.problem}", 2)
    except UserError as error:
        return _fail(str(error), 2)
    except KeyboardInterrupt:
        return _fail("stopped by Ctrl-C", 130)
    except BrokenPipeError:  # the reader of our output has gone, as `| head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141  # as of all that end by it: a training has not come to its end
    except MemoryError:
        return _fail(_OUT_OF_MEMORY, 2)
    except RuntimeError as error:
        if not _is_out_of_memory(error):
            raise
        return _fail(_OUT_OF_MEMORY, 2)
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return _fail(f"{where}{error.strerror or error}", 2)


def _parse(arguments: list[str]) -> Any:
    """The verb's dataclass. Leaves the process, as argparse does, after help or with a mistake."""
    arguments = [_FORMER_NAMES.get(arguments[0], arguments[0]), *arguments[1:]]
    choices = []
    for name, verb in VERBS.items():
        # The list of verbs shows what each does, its own help also how to use it.
        text = inspect.cleandoc(verb.__doc__ or "")
        shown = text if arguments[0] == name else text.splitlines()[0]
        choices.append(Annotated[verb, tyro.conf.subcommand(name, description=shown)])
    union: Any = Union[tuple(choices)]  # noqa: UP007 (made at run time)
    return tyro.cli(
        union,
        prog="snowsplat",
        description=DESCRIPTION,
        args=arguments,
        config=(tyro.conf.FlagCreatePairsOff,),
    )


def _is_out_of_memory(error: RuntimeError) -> bool:
    """Whether torch says so, of a GPU or of the computer; it has a class for the first alone."""
    words = str(error)
    return any(said in words for said in ("out of memory", "not enough memory", "allocate memory"))


def _fail(message: str, code: int) -> int:
    _tell(message)
    return code


def _tell(message: str) -> None:
    print("snowsplat:", printable(" ".join(message.split())), file=sys.stderr)


class _Notes(logging.Handler):
    """What the program logs, as lines of the same kind."""

    def emit(self, record: logging.LogRecord) -> None:
        _tell(record.getMessage())


def _say_notes_and_warnings_in_one_line() -> None:
    def show(message: Warning | str, *_: Any, **__: Any) -> None:
        _tell(f"warning: {message}")

    warnings.showwarning = show
    # Of a damaged photo Pillow notes each word that it could not read; we say once what it costs.
    warnings.filterwarnings("ignore", module=r"PIL\.")
    logger = logging.getLogger("snowsplat")
    if not logger.handlers:
        logger.addHandler(_Notes())
        logger.setLevel(logging.INFO)
