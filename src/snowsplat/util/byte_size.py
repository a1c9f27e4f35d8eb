"""Numbers of bytes as text: "4GB"."""

import re

from snowsplat.util.errors import SettingError

#: Bytes of the decimal units, by prefix, in ascending order. For units such as GiB, the exponent of
#: 1024 is the index.
_UNITS = {"": 1, "k": 10**3, "m": 10**6, "g": 10**9, "t": 10**12}


def parse_bytes(text: str) -> int:
    """The number of bytes of "4GB", "800 MB", "1.5g" or a plain number; "GiB" is 1024³ bytes.

    Raises:
        SettingError: the text of ``memory`` is not a size.
    """
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*([kmgt]?)(i?)b?\s*", text.lower())
    if match is None or (match[3] and not match[2]) or float(match[1]) <= 0:
        raise SettingError("memory", f"{text!r} is not a size; use e.g. 4GB or 800MB")
    unit = _UNITS[match[2]]
    if match[3]:
        unit = 1024 ** (list(_UNITS).index(match[2]))
    return int(float(match[1]) * unit)


def format_bytes(count: int) -> str:
    """Text such as "1.3 GB" or "240 MB"."""
    return f"{count / 1e9:.1f} GB" if count >= 0.95e9 else f"{max(1, round(count / 1e6))} MB"
