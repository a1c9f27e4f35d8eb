"""The command `snowsplat`: selects the subcommand, runs it, and reports errors.

Exit codes: 0 success; 2 an error in the flags or the input, reported as one line on stderr;
130 interrupted by Ctrl-C, with all finished results saved; 141 the reader of the output has closed
it. Any other failure is a defect of the program and shows a traceback.
"""

import difflib
import inspect
import logging
import os
import sys
import warnings
from collections.abc import Sequence
from dataclasses import make_dataclass
from importlib import import_module
from typing import Annotated, Any, Union

import tyro

from snowsplat.cli.flags import with_flags
from snowsplat.cli.help_text import join_lines_of_field_docstrings
from snowsplat.util.errors import SettingError, UserError
from snowsplat.util.safe_json import printable

#: The subcommands with the first line of their docstrings. The subcommand ``train`` is the
#: dataclass ``Train`` in the module ``snowsplat.cli.train``, which is imported when it is called.
SUBCOMMANDS = {
    "demo": "Try snowsplat: make a scene from rendered photos of a synthetic scene.",
    "make": "Make a scene from photos or a video: sfm, train and render in one command.",
    "sfm": "Estimate the camera poses of photos or a video, and create a dataset.",
    "train": "Train a scene from photos with known camera poses (COLMAP or transforms.json).",
    "evaluate": "Compare a scene with the held-out photos: PSNR, SSIM and, with weights, LPIPS.",
    "render": "Render images at the camera poses of the photos, or a video.",
    "view": "Show a finished scene in the browser.",
    "watch": "Show an ongoing or finished training run in the browser, with its photos.",
    "convert": "Write a scene in another file format; crop, decimate, transform or merge scenes.",
    "clean": "Remove floaters: Gaussians that hang in front of the surfaces.",
    "lift": "Make a scene from one photo and its depth map.",
    "image": "Approximate a photo by 2D Gaussians, or render such an approximation.",
    "publish": "Write a static web site that shows a scene.",
    "globe": "Put a scene into a snow globe: a web page, and a video.",
    "benchmark": "Train and evaluate all scenes of a folder by the protocol of the papers.",
    "blocks": "Train a scene that is larger than the memory, in blocks that are merged.",
    "info": "Describe a scene, a point cloud, a dataset, a checkpoint or an output folder.",
}

# Former names of subcommands, still accepted but not listed.
_FORMER_NAMES = {"capture": "sfm"}

DESCRIPTION = """3D Gaussian Splatting on any computer: makes a 3D scene from photos or a video.

  snowsplat demo                          try it, without own photos
  snowsplat make PHOTOS                   photos or a video -> a scene
  snowsplat sfm PHOTOS -o DATASET         photos or a video -> a dataset
  snowsplat train DATASET -o OUT --eval   a dataset -> a scene in OUT
  snowsplat evaluate OUT                  PSNR and SSIM on the held-out photos
  snowsplat render OUT                    images and videos of the scene
  snowsplat view FILE|OUT                 show a finished scene in the browser
  snowsplat watch OUT                     show the training in the browser
  snowsplat convert SCENE [MORE …] FILE   another format; crop, decimate, merge
  snowsplat clean SCENE FILE              the scene without floaters
  snowsplat lift PHOTO --depth MAP -o OUT one photo and its depth -> a scene
  snowsplat image PHOTO -o OUT            a photo as 1000 Gaussians
  snowsplat publish SCENE -o FOLDER       a web site, for any host
  snowsplat globe SCENE                   a snow globe, as a web page
  snowsplat benchmark FOLDER -o OUT       all scenes of a folder, and a table
  snowsplat blocks plan DATASET -o OUT    a scene larger than the memory, in blocks
  snowsplat info PATH                     describe a file or a folder

A dataset is a folder of photos with their camera poses.

Each subcommand has its own help: snowsplat train --help

For shell completion, add this line to your shell's startup file:
  eval "$(snowsplat --tyro-print-completion bash)"    (or zsh)"""


_OUT_OF_MEMORY = (
    "out of memory; train with --memory and a smaller number, or use smaller photos, -r 2"
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command with the arguments ``argv`` (default: ``sys.argv[1:]``).

    Returns the exit code.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    _report_log_and_warnings_as_lines()
    try:
        return int(parse(arguments or ["--help"]).run())
    except SettingError as error:
        return _fail(with_flags(f"`{error.setting}`: {error.problem}"), 2)
    except UserError as error:
        return _fail(with_flags(str(error)), 2)
    except KeyboardInterrupt:
        return _fail("stopped by Ctrl-C", 130)
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
        where = f"{error.filename}: " if error.filename else ""
        return _fail(f"{where}{error.strerror or error}", 2)


def parse(arguments: Sequence[str]) -> Any:
    """Parse the arguments into the dataclass of their subcommand.

    Exits the process, as argparse does, after printing a help text or an error in the flags.

    Raises:
        UserError: an unknown subcommand.
    """
    name, *rest = arguments
    name = _FORMER_NAMES.get(name, name)
    if name not in SUBCOMMANDS and not name.startswith("-"):
        raise UserError(_unknown_subcommand(name))
    union: Any = Union[tuple(_choices(name))]  # noqa: UP007 (made at run time)
    return tyro.cli(
        union,
        prog="snowsplat",
        description=DESCRIPTION,
        args=[name, *rest],
        config=(tyro.conf.FlagCreatePairsOff,),
    )


def _choices(called: str) -> list[Any]:
    """What tyro chooses from: the subcommand ``called``, and the others without their flags.

    Importing and analysing all of them takes longer than everything else that a help text needs.
    Only completion scripts and suggestions for a misplaced flag need the flags of all subcommands.
    """
    load_all = called.startswith("-") and called not in ("-h", "--help")
    choices = []
    for name, summary in SUBCOMMANDS.items():
        load = load_all or name == called
        if load:
            kind = load_subcommand(name)
            join_lines_of_field_docstrings(kind)
        else:
            kind = make_dataclass(name.capitalize(), [])
        text = inspect.cleandoc(kind.__doc__ or "") if name == called else summary
        choices.append(Annotated[kind, tyro.conf.subcommand(name, description=text)])
    return choices


def load_subcommand(name: str) -> Any:
    """Import the dataclass of a subcommand."""
    return getattr(import_module(f"snowsplat.cli.{name}"), name.capitalize())


def _unknown_subcommand(name: str) -> str:
    similar = difflib.get_close_matches(name, [*SUBCOMMANDS, *_FORMER_NAMES], 1)
    if similar:
        hint = f"did you mean {_FORMER_NAMES.get(similar[0], similar[0])}?"
    else:
        hint = f"choose from {', '.join(SUBCOMMANDS)}"
    return f"{name}: unknown subcommand; {hint} (snowsplat --help describes all of them)"


def _is_out_of_memory(error: RuntimeError) -> bool:
    """Whether torch ran out of memory; it has an exception class for GPU memory only."""
    text = str(error)
    return any(part in text for part in ("out of memory", "not enough memory", "allocate memory"))


def _fail(message: str, code: int) -> int:
    _print_error(message)
    return code


def _print_error(message: str) -> None:
    print("snowsplat:", printable(" ".join(message.split())), file=sys.stderr)


class _LogHandler(logging.Handler):
    """Prints log records in the same form as errors."""

    def emit(self, record: logging.LogRecord) -> None:
        _print_error(record.getMessage())


def _report_log_and_warnings_as_lines() -> None:
    def show(message: Warning | str, *_: Any, **__: Any) -> None:
        _print_error(f"warning: {message}")

    warnings.showwarning = show
    # Pillow warns about each unreadable tag of a damaged photo; snowsplat reports its effect once.
    warnings.filterwarnings("ignore", module=r"PIL\.")
    logger = logging.getLogger("snowsplat")
    if not logger.handlers:
        logger.addHandler(_LogHandler())
        logger.setLevel(logging.INFO)
