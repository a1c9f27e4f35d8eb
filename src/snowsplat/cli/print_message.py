"""`print_message`: prints a message."""

from __future__ import annotations

from typing import Any

from snowsplat.util.messages import Message, as_message


def print_message(key: str | Message, /, **values: Any) -> None:
    """Print a message at once, in the language of the program; see `message`."""
    print(Message(key, values) if isinstance(key, str) else as_message(key), flush=True)
