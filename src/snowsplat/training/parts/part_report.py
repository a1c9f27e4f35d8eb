"""`PartReport`: what a part has to report at the end of a training."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from PIL import Image

from snowsplat.evaluation.verdict import Reason
from snowsplat.util.messages import Message


@dataclass(frozen=True)
class Section:
    """A section of the page about the training.

    Attributes:
        title: of the section.
        text: its sentences.
        values: a number for each training photo, which a chart shows; may be empty.
        label: of these numbers; None: there are none.
        masks: by the name of the training photo, of its size: 0 where the page tints the photo.
    """

    title: Message
    text: tuple[Message, ...]
    values: tuple[float, ...] = ()
    label: Message | None = None
    masks: Mapping[str, Image.Image] = field(default_factory=dict)


@dataclass(frozen=True)
class PartReport:
    """Everything may be empty.

    Attributes:
        lines: clauses without a full stop, for the terminal and the page.
        reasons: for the verdict on the scene; among those of a grade, the worst one is first.
        files: by their paths in the output folder: values of JSON, or images.
        sections: of the page.
        facts: what `sections` say, for programs.
    """

    lines: tuple[Message, ...] = ()
    reasons: tuple[Reason, ...] = ()
    files: Mapping[str, Any] = field(default_factory=dict)
    sections: tuple[Section, ...] = ()
    facts: Mapping[str, Any] = field(default_factory=dict)
