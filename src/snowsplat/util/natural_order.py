"""The order of names in which numbers count by their value."""

import re

_DIGITS = re.compile(r"([0-9]+)")


def natural_key(name: str) -> tuple[list[tuple[int, int, str]], str]:
    """A key to sort names: img_9 comes before img_10, and img_09 before img_9."""
    parts = _DIGITS.split(name)  # text, digits, text, digits …
    for index in range(1, len(parts), 2):
        parts[index] = parts[index].lstrip("0")
    return [(index % 2, len(part) * (index % 2), part) for index, part in enumerate(parts)], name
