"""`Finding`: one thing about the cameras of a dataset that is wrong or in doubt."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """What a check has found, for the user.

    Attributes:
        about: the quantity, in one or two words: "field of view", "axes".
        text: one sentence with numbers, without a full stop. If ``impossible``, it also says what
            to do, after a semicolon.
        impossible: no real camera is like this, or the evidence is overwhelming. False: in doubt;
            the data may be unusual but right.
        photos: the views whose poses are wrong, if those of the others are right.
    """

    about: str
    text: str
    impossible: bool = False
    photos: tuple[str, ...] = ()
