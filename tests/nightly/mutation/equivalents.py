"""Faults that change nothing that can be observed, with the reason of each.

A fault is known by its file and by the lines before and after it, so it may move within its file.
An entry that no fault matches is reported by mutate.py.
"""

from __future__ import annotations

#: {(file in the package, lines before, lines after): why no test can notice it}
EQUIVALENTS: dict[tuple[str, str, str], str] = {}
