"""`lens_findings`: real lenses pass, impossible ones are named."""

import pytest

from snowsplat.data.judge.lens_check import field_of_view, lens_findings


def found(*intrinsics: float) -> list[tuple[str, bool]]:
    width, height, *rest = intrinsics
    findings = lens_findings(int(width), int(height), *rest)
    return [(finding.about, finding.impossible) for finding in findings]


@pytest.mark.parametrize(
    ("width", "height", "focal"),
    [
        pytest.param(4000, 3000, 2900, id="phone"),
        pytest.param(4000, 3000, 1450, id="wide phone lens, 108° over the long side"),
        pytest.param(6000, 4000, 100_000, id="600 mm"),
        pytest.param(270, 480, 342, id="small portrait"),
    ],
)
def test_real_lenses(width: int, height: int, focal: float) -> None:
    findings = found(width, height, focal, focal, width / 2, height / 2)
    assert all(not impossible for _, impossible in findings)
    assert len(findings) == (field_of_view(width, focal) < 5)


def test_angle() -> None:
    assert field_of_view(200, 100) == pytest.approx(90)


@pytest.mark.parametrize(
    ("intrinsics", "expected"),
    [
        ((1500, 1000, 35.7, 35.7, 750, 500), ("field of view", True)),  # millimetres
        ((1024, 768, 5e6, 5e6, 512, 384), ("field of view", True)),
        ((1024, 768, 166503.9, 166503.9, 512, 384), ("field of view", False)),
        ((1024, 768, 956, 927, 512, 384), ("pixel aspect", False)),
        ((1024, 768, 956, 956, 1100, 384), ("principal point", True)),
        ((1024, 768, 956, 956, 0.5, 0.5), ("principal point", False)),  # in units of the size
    ],
)
def test_unusual(intrinsics: tuple[float, ...], expected: tuple[str, bool]) -> None:
    assert found(*intrinsics) == [expected]
