"""Charts: round ticks, curves within the frame, no values that are not finite."""

import math
import re
import xml.etree.ElementTree as ET

import pytest

from snowsplat.util.charts import chart, smoothed, tick_labels, ticks


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (0, 1, [0, 0.5, 1.0]),
        (0, 53000, [0, 20000, 40000, 60000]),
        (19.2, 30.7, [15, 20, 25, 30, 35]),
        (0, 0.0731, [0, 0.05, 0.1]),
        (0, 100, [0, 50, 100]),
    ],
)
def test_ticks_are_round_and_cover_the_range(low, high, expected):
    assert ticks(low, high, 4) == pytest.approx(expected)


@pytest.mark.parametrize("value", [0.0, 3.0, 1e-20, -5.0, 1e30])
def test_ticks_of_a_single_value(value):
    found = ticks(value, value, 5)
    assert 2 <= len(found) < 20
    assert found[0] <= value <= found[-1]


def test_tick_labels():
    assert tick_labels([0, 20000, 40000]) == ["0", "20k", "40k"]
    assert tick_labels([0, 0.02, 0.04]) == ["0", "0.02", "0.04"]
    assert tick_labels([0, 500, 1000, 1500]) == ["0", "500", "1000", "1500"]
    assert tick_labels([1e6, 1.5e6]) == ["1.0M", "1.5M"]
    assert tick_labels([20, 25, 30]) == ["20", "25", "30"]


def test_smoothed_keeps_lines_and_ends():
    line = [(i, 2.0 * i + 1) for i in range(20)]
    assert [y for _, y in smoothed(line, 4)] == pytest.approx([y for _, y in line])
    zigzag = [(i, float(i % 2)) for i in range(21)]
    assert max(abs(y - 0.5) for _, y in smoothed(zigzag, 6)[6:-6]) < 0.05
    assert smoothed([], 3) == []


def test_chart_draws_everything_within_its_frame():
    points = [(i, 1.0 / (i + 1)) for i in range(50)]
    raw = [(i, y + 0.1 * math.sin(i)) for i, y in points]
    raw[7] = (7, 1e6)  # an outlier
    svg = chart(points, raw=raw, x_label="steps", y_label="loss <L1>", dots=True)
    root = ET.fromstring(svg)
    assert root.find("{http://www.w3.org/2000/svg}title").text == "loss <L1>"
    assert "steps" in "".join(root.itertext())
    _, _, width, height = map(float, root.get("viewBox").split())
    drawn = [e.get("d") for e in root.iter() if e.get("class") in ("curve", "raw")]
    assert len(drawn) == 2
    for path in drawn:
        numbers = [float(number) for number in re.findall(r"-?[\d.]+", path)]
        assert len(numbers) == 100
        assert 0 <= min(numbers[0::2]) <= max(numbers[0::2]) <= width
        assert 0 <= min(numbers[1::2]) <= max(numbers[1::2]) <= height
    # The outlier does not flatten the curve.
    ys = [float(y) for y in re.findall(r" ([\d.]+)", drawn[1])]
    assert max(ys) - min(ys) > height / 2
    assert sum(e.get("class") == "dot" for e in root.iter()) == 50


def test_chart_of_few_points():
    assert chart([], x_label="x", y_label="y") == ""
    assert chart([(1, math.nan), (2, math.inf)], x_label="x", y_label="y") == ""
    for points in ([(5.0, 3.0)], [(0.0, 0.0)], [(1.0, 2.0), (2.0, 2.0)]):
        svg = chart(points, x_label="x", y_label="y", from_zero=False)
        assert "nan" not in svg
        assert "<circle" in svg or "curve" in svg
