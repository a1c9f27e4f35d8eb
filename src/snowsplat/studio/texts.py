"""Texts for the page, which shows them in the language that was chosen in the browser."""

from snowsplat.evaluation.verdict import Verdict
from snowsplat.util.messages import as_message, message
from snowsplat.util.safe_json import printable

#: What stages count, see `sfm.progress.Report`: `in_languages` finds their Chinese by the English.
ITEMS = (
    message("registered photos"),
    message("prepared photos"),
    message("photos with features"),
    message("matched pairs"),
    message("verified pairs"),
    message("comparisons of photos"),
    message("photos"),
    message("frames"),
    message("views"),
    message("trials"),
    message("files"),
)
#: A text in each language.
Texts = dict[str, str]


def in_languages(text: object) -> Texts:
    """A text of any origin in each language, in one line."""
    told = as_message(text).in_all_languages()
    return {language: printable(" ".join(words.split())) for language, words in told.items()}


def verdict_in_languages(verdict: Verdict) -> dict[str, object]:
    """A verdict on a scene: its grade, its head, its reasons and its advice."""
    return {
        "grade": verdict.grade,
        "head": in_languages(verdict.head(message("the scene"))),
        "why": [in_languages(why) for why in verdict.why()],
        "advice": [in_languages(message("next time: {advice}", advice=a)) for a in verdict.advice],
    }
