"""Help texts of flags: the docstring of a field, with its lines joined into one paragraph.

tyro wraps a help text to the width of the terminal, but it keeps the line breaks of field
docstrings. If the metadata of a field contain the entry "help", tyro uses this text instead.
"""

import ast
import inspect
import textwrap
from dataclasses import fields
from itertools import pairwise
from types import MappingProxyType
from typing import Any


def join_lines_of_field_docstrings(kind: Any) -> None:
    """Store the joined docstrings of the fields of a dataclass in the metadata of the fields."""
    texts: dict[str, str] = {}
    for base in reversed(kind.__mro__[:-1]):
        texts |= _field_docstrings(base)
    for field in fields(kind):
        if field.name in texts:
            field.metadata = MappingProxyType({**field.metadata, "help": texts[field.name]})


def _field_docstrings(kind: type) -> dict[str, str]:
    """Name of a field -> the string below it in the source of the class, on one line."""
    try:
        source = inspect.getsource(kind)
    except (OSError, TypeError):  # no sources: installed without them, or made at run time
        return {}
    (definition,) = ast.parse(textwrap.dedent(source)).body
    assert isinstance(definition, ast.ClassDef)
    texts = {}
    for field, below in pairwise(definition.body):
        match field, below:
            case (
                ast.AnnAssign(target=ast.Name(id=name)),
                ast.Expr(value=ast.Constant(value=str(text))),
            ):
                texts[name] = " ".join(text.split())
    return texts
