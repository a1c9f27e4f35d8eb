"""Numbers of bytes as text: "4GB"."""

import re

from snowsplat.util.errors import SettingError

#: Bytes of the decimal units, by prefix, in ascending order. For units such as GiB, the exponent of
#: 1024 is the index.
_UNITS = {"": 1, "k": 10**3, "m": 10**6, "g": 10**9, "t": 10**12}


def parse_bytes(text: str) -> int:
    """The number of bytes of "4GB", "800 MB", "1.5g" or a plain number; "GiB" is 1024³ bytes.

    Raises: SettingError: the text of ``memory`` is not a size.
    """
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*([kmgt]?)(i?)b?\s*", text.lower())
    if match is None or (match[3] and not match[2]) or float(match[1]) <= 0:
        raise SettingError("memory", "{text!r} is not a size; use e.g. 4GB or 800MB", text=text)
    unit = _UNITS[match[2]]
    if match[3]:
        unit = 1024 ** (list(_UNITS).index(match[2]))
    return int(float(match[1]) * unit)


def format_bytes(count: int) -> str:
    """Text such as "1.3 GB", "240 MB", "3.4 MB" or "31 kB"."""
    for unit, name in ((1e9, "GB"), (1e6, "MB"), (1e3, "kB")):
        if count >= 0.95 * unit:
            return f"{count / unit:.{int(count < 10 * unit or name == 'GB')}f} {name}"
    return f"{count} bytes"
