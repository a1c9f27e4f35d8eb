"""Text for terminals and pipes that cannot show all characters, such as latin-1, ASCII or cp437.

Characters that the encoding of the terminal lacks are replaced by similar ones: "…" by "...", "×"
by "x", the box of a help text by "+", "-" and "|". Files are not concerned: snowsplat writes all of
them in UTF-8.
"""

import codecs
import sys
import unicodedata
from contextlib import suppress
from io import TextIOWrapper

_ERRORS = "snowsplat-similar"  # the name of the error handler
_SIMILAR = {
    **dict.fromkeys("–—‐‑‒−─━╌┄", "-"),
    **dict.fromkeys("│┃║╎┆", "|"),
    **dict.fromkeys("╭╮╰╯┌┐└┘├┤┬┴┼╔╗╚╝", "+"),
    **dict.fromkeys("‘’′", "'"),
    **dict.fromkeys("“”″„«»", '"'),
    **dict.fromkeys("·•∙●", "*"),
    **dict.fromkeys("█▇▆▅▉▊▓", "#"),
    **dict.fromkeys("▄▃▂▁▋▌▍▎▏▒░", "-"),
    "×": "x",
    "±": "+/-",
    "≤": "<=",
    "≥": ">=",
    "≈": "~",
    "≠": "!=",
    "∞": "inf",
    "√": "sqrt",
    "→": "->",
    "←": "<-",
    "↔": "<->",
    "↑": "^",
    "↓": "v",
    "✓": "ok",
    "✗": "x",
    "⚠": "!",
    "°": " deg",
    "µ": "u",
    "σ": "sigma",
    "Σ": "Sigma",
    "α": "alpha",
    "λ": "lambda",
}


def accept_all_characters() -> None:
    """Make stdout and stderr replace the characters that their encoding lacks."""
    codecs.register_error(_ERRORS, _replace)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):  # not in all notebooks; None without a terminal
            # Python looks for the position in a file, which a redirected stream may not have.
            with suppress(OSError):
                stream.reconfigure(errors=_ERRORS)


def similar(character: str) -> str:
    """``character`` in ASCII; it is escaped, as in ``\\u672c``, if no other is similar."""
    if character in _SIMILAR:
        return _SIMILAR[character]
    if not unicodedata.category(character).startswith("L"):  # "½" -> "1/2", "²" -> "2"
        plain = unicodedata.normalize("NFKD", character).replace("\N{FRACTION SLASH}", "/")
        if plain.isascii():
            return plain
    # Letters are mostly those of a file name, which must not become the name of another file.
    return character.encode("ascii", "backslashreplace").decode("ascii")


def _replace(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return "".join(map(similar, error.object[error.start : error.end])), error.end
