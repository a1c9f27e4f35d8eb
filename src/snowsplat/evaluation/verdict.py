"""`Verdict`: whether photos or a scene are good, usable or poor; why; what to do next time.

Whoever judges lists reasons. The worst grade of a reason is the grade of the verdict.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

from snowsplat.util.html import text
from snowsplat.util.safe_json import from_json

Grade = Literal["good", "usable", "poor"]

#: From the worst to the best.
GRADES: tuple[Grade, ...] = ("poor", "usable", "good")
#: At most this number of reasons is told, and as many kinds of advice: more are not read.
_TOLD = 3
_MEANING = {"good": "", "usable": ", with limits", "poor": "; expect blurred or wrong parts"}

#: The style of `Verdict.html`.
STYLE = """
.verdict { border-left: 6px solid var(--soft); background: var(--card); border-radius: 8px;
  padding: 12px 18px; margin: 18px 0; }
.verdict b { font-size: 1.25rem; } .verdict ul { margin: 6px 0; padding-left: 1.3em; }
.verdict.good { border-color: #2e8b57; } .verdict.usable { border-color: var(--accent); }
.verdict.poor { border-color: var(--bad); }
"""


@dataclass(frozen=True)
class Reason:
    """One reason."""

    grade: Grade  # the best grade that is possible with this reason; "good": only a remark
    text: str  # a clause without a full stop
    advice: str = ""  # what to do next time, as an imperative clause; empty: nothing


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
    def advice(self) -> list[str]:
        """What to do next time, each advice once."""
        return list(dict.fromkeys(reason.advice for reason in self.told if reason.advice))

    def lines(self, what: str) -> list[str]:
        """The verdict as lines for a terminal. ``what``: what is judged, such as "the photos"."""
        return [
            f"{what}: {self.grade}{_MEANING[self.grade]}",
            *(f"  {self._mark(reason)} {reason.text}" for reason in self.told),
            *(f"  next time: {advice}" for advice in self.advice),
        ]

    def _mark(self, reason: Reason) -> str:
        """What stands before a reason: "also:" before a remark that is none for this grade."""
        return "-" if self.grade == "good" or reason.grade != "good" else "also:"

    def html(self, what: str) -> str:
        """The verdict as a box of a page with `STYLE`."""
        marked = [(self._mark(reason), reason.text) for reason in self.told]
        told = [why if mark == "-" else f"{mark} {why}" for mark, why in marked]
        reasons = "".join(f"<li>{text(_sentence(why))}</li>" for why in told)
        advice = "".join(f"<li>{text(_sentence(advice))}</li>" for advice in self.advice)
        return (
            f'<div class="verdict {self.grade}"><b>{text(_sentence(what))}: {self.grade}</b>'
            f"{_MEANING[self.grade]}"
            + (f"<ul>{reasons}</ul>" if reasons else "")
            + (f"<p>Next time:</p><ul>{advice}</ul>" if advice else "")
            + "</div>"
        )


def _sentence(clause: str) -> str:
    return clause[:1].upper() + clause[1:]
