"""`Verdict`: whether photos or a scene are good, usable or poor; why; what to do next time.

Whoever judges lists reasons. The worst grade of a reason is the grade of the verdict.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

from snowsplat.util.messages import Message, message
from snowsplat.util.safe_json import from_json

Grade = Literal["good", "usable", "poor"]

#: From the worst to the best.
GRADES: tuple[Grade, ...] = ("poor", "usable", "good")
#: At most this number of reasons is told, and as many kinds of advice: more are not read.
_TOLD = 3
_MEANING = {
    "good": message("{what}: good"),
    "usable": message("{what}: usable, with limits"),
    "poor": message("{what}: poor; expect blurred or wrong parts"),
}
_NO_ADVICE = Message("")


@dataclass(frozen=True)
class Reason:
    """One reason."""

    grade: Grade  # the best grade that is possible with this reason; "good": only a remark
    text: Message  # a clause without a full stop
    advice: Message = _NO_ADVICE  # what to do next time, an imperative clause; empty: nothing
    # A prediction from the photos alone. What photos show that were held out has priority.
    predicted: bool = False


@dataclass(frozen=True)
class Verdict:
    """A verdict. All fields can be stored as JSON."""

    grade: Grade  # of what is judged
    reasons: tuple[Reason, ...]  # all reasons, the worst first; remarks are last

    @classmethod
    def of(cls, reasons: Sequence[Reason]) -> Verdict:
        """The verdict for reasons; among those of the same grade, the first is the worst one."""
        ordered = sorted(reasons, key=lambda reason: GRADES.index(reason.grade))
        return cls(ordered[0].grade if ordered else "good", tuple(ordered))

    @classmethod
    def from_json(cls, values: Any) -> Verdict | None:
        """The verdict of `as_json`; None if the values are something else."""
        try:
            reasons = [from_json(Reason, reason) for reason in values["reasons"]]
        except (ValueError, TypeError, KeyError):
            return None
        return cls.of(reasons)

    def as_json(self) -> dict[str, Any]:
        """The grade and the reasons as JSON values."""
        return asdict(self)

    @property
    def told(self) -> tuple[Reason, ...]:
        """The reasons that are told, at most three."""
        return self.reasons[:_TOLD]

    @property
    def advice(self) -> list[Message]:
        """What to do next time, each advice once."""
        return list(dict.fromkeys(reason.advice for reason in self.told if reason.advice))

    def head(self, what: Message) -> Message:
        """The grade in a line. ``what``: what is judged, such as "the photos"."""
        return replace(_MEANING[self.grade], values={"what": what})

    def why(self) -> list[Message]:
        """The reasons that are told: a remark that is none for this grade begins with "also:"."""
        remark = [self.grade != "good" and reason.grade == "good" for reason in self.told]
        return [
            message("also: {reason}", reason=reason.text) if also else reason.text
            for also, reason in zip(remark, self.told, strict=True)
        ]

    def lines(self, what: Message) -> list[str]:
        """The verdict as lines for a terminal. ``what``: see `head`."""
        marks = ["" if why.key.startswith("also:") else "- " for why in self.why()]
        return [
            str(self.head(what)),
            *(f"  {mark}{why}" for mark, why in zip(marks, self.why(), strict=True)),
            *("  " + str(message("next time: {advice}", advice=each)) for each in self.advice),
        ]
