"""Lists of names for a line of text."""

from collections.abc import Sequence

from snowsplat.util.messages import Message, message


def first_names(names: Sequence[str | Message], most: int) -> Message:
    """The first ``most`` names, and how many more there are: "a, b and 5 more"."""
    if len(names) <= most:
        return message("{names}", names=names)
    more = len(names) - most
    return message("{names} and {more} more", names=names[:most], more=more)


def all_names(names: Sequence[str | Message]) -> Message:
    """At least one name: "a and b"."""
    listed = message("{name}", name=names[0])
    for name in names[1:]:
        listed = message("{first} and {last}", first=listed, last=name)
    return listed
