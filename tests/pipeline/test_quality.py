"""The quality that `make` chooses for a time budget."""

from snowsplat.pipeline.quality import quality_within


def test_quality_within_a_time_budget():
    assert [quality_within(seconds, 50, 0, 2) for seconds in (30, 60, 300, 3600)] == [
        *("draft", "draft", "normal", "best"),
    ]
    assert quality_within(300, 50, 0, 16) == "best"
    assert quality_within(300, 1000, 0, 2) == "draft"
    assert quality_within(120, 0, 1, 2) == "draft"
    assert quality_within(240, 0, 1, 2) == "normal"
