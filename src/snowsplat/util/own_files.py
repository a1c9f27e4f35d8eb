"""Python files of the user (`--import FILE`): what they register, the command knows.

The variable SNOWSPLAT_IMPORT passes them on to the processes that a command starts.
"""

import os
import sys
from collections.abc import Iterable
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from zlib import crc32

from snowsplat.util.errors import UserError

_VARIABLE = "SNOWSPLAT_IMPORT"


def own_files() -> list[str]:
    """The absolute paths of the files that are imported."""
    return [file for file in os.environ.get(_VARIABLE, "").split(os.pathsep) if file]


def import_own_files(more: Iterable[str] = ()) -> None:
    """Import those of the environment and ``more``, each once in a process.

    What the code of a file raises is passed on.

    Raises: UserError: there is no such Python file, or it has an error of syntax.
    """
    files = list(dict.fromkeys([*own_files(), *map(os.path.abspath, more)]))
    for file in files:
        # Other processes find its classes by this name.
        name = f"{Path(file).stem}_{crc32(os.fsencode(file)):08x}"
        if name in sys.modules:
            continue
        spec = spec_from_file_location(name, file)
        if spec is None or spec.loader is None or not os.path.isfile(file):
            raise UserError("{file}: is no Python file; import a .py file", file=file)
        sys.modules[name] = module_from_spec(spec)
        try:
            spec.loader.exec_module(sys.modules[name])
        except SyntaxError as error:
            what, line = error.msg, error.lineno
            raise UserError(
                "{file}, line {line}: {what}", file=file, line=line, what=what
            ) from None
    if files:
        os.environ[_VARIABLE] = os.pathsep.join(files)
