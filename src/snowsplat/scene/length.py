"""Lengths: what a world unit is in metres, and lengths that people write.

The true scale of a scene is the number of metres in one of its world units, `metres_per_unit` of
the Gaussians and of a dataset. None: it is unknown, as for photos without any measure. Files say
it: a comment of PLY, an entry of SOG, the node of glTF, whose unit is the metre; a file beside
other ones.
"""

import re

from snowsplat.util.errors import Problem

#: What is written after a number, in metres.
UNITS = {"mm": 0.001, "cm": 0.01, "m": 1.0, "km": 1000.0, "in": 0.0254, "ft": 0.3048}
_LENGTH = re.compile(r"([0-9]*\.?[0-9]+(?:e[+-]?[0-9]+)?)\s*([a-z]+)", re.IGNORECASE)
# A unit between these lengths, in metres: what is smaller or larger is damaged, not measured.
_LEAST, _MOST = 1e-12, 1e12


def metres_of(text: str) -> float:
    """The length that ``text`` states, such as "0.45m", "45 cm" or "17.5in", in metres.

    Raises: ValueError: there is no positive number, or no unit after it.
    """
    found = _LENGTH.fullmatch(text.strip())
    unit = UNITS.get(found[2].lower()) if found else None
    metres = float(found[1]) * unit if found and unit else 0.0
    if not _LEAST < metres < _MOST:
        known = ", ".join(UNITS)
        raise Problem(
            "{text!r} is not a length; use a number with its unit ({known}): 0.45m",
            text=text,
            known=known,
        )
    return metres


def stored_metres(value: object) -> float | None:
    """The metres per unit that a value from a file stands for; None if it is no positive number."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value) if _LEAST < value < _MOST else None
