"""Messages of the page: those it sends are understood, all others are refused."""

import json
import math

import pytest

from snowsplat.viewer.live.browser import Key, Share, Shown, Thumbnails, Training, parse, to_json
from snowsplat.viewer.live.pictures import Display, View

from .. import clients


def test_messages_of_the_page():
    seen = parse(clients.view(number=7, position=[1, 2.5, -3], photo=2))
    assert isinstance(seen, View)
    assert (seen.number, seen.photo) == (7, 2)
    assert seen.camera(4, 3).position.tolist() == [1.0, 2.5, -3.0]
    shown = parse(clients.display(mode="depth", crop=[[0, 0, 0], [1, 1, 1]]))
    assert isinstance(shown, Display)
    assert shown.crop == ((0, 0, 0), (1, 1, 1))
    assert parse('{"type": "shown", "number": 3}') == Shown(3)
    assert parse('{"type": "training", "do": "pause"}') == Training("pause")
    assert parse('{"type": "share", "share": 0.3}') == Share(0.3)
    assert parse('{"type": "thumbnails", "count": 4}') == Thumbnails(4)
    assert parse('{"type": "key"}') == Key()


def test_other_messages_are_refused():
    """Or, if a wrong value is possible at its place, it is limited."""
    refused = 0
    for text in clients.wrong_messages():
        try:
            message = parse(text)
        except ValueError:
            refused += 1
            continue
        if isinstance(message, View):
            assert message.camera(4, 3).is_finite(), text
        elif isinstance(message, Display):
            assert 320 <= message.longest <= 2560, text
            assert 0 <= message.degree <= 3, text
            assert 0.02 <= message.scale <= 1.0, text
            assert 0.0 <= message.wipe <= 1.0, text
        elif isinstance(message, Share):
            assert 0.05 <= message.share <= 0.95, text
    assert refused > 200
    for text in ("[" * 4000, "[" * 60_000, "9" * 4000, clients.view()[:-9], "\ufeff", "\0"):
        with pytest.raises(ValueError):  # noqa: PT011 - any one
            parse(text)


def test_numbers_are_what_json_has():
    values = {"loss": math.nan, "curve": [(1.0, math.inf), (math.pi, 2)]}
    assert json.loads(to_json(values)) == {
        "loss": None,
        "curve": [[1.0, None], [3.141593, 2]],
    }
