"""The kernels in WGSL have the constants of the C++ headers."""

import math
import re
from pathlib import Path

import pytest

NATIVE = Path(__file__).parents[2] / "src" / "snowsplat" / "native"
FILES = sorted(NATIVE.glob("wgsl/*.wgsl"))
NUMBER = r"-?\d[\d.e+-]*"


def constants(text: str) -> dict[str, list[float]]:
    """Name -> the numbers of constants that are numbers, or lists of them."""
    text = re.sub(r"//[^\n]*", "", text)
    value = rf"(?:array<[^>]*>\(|{{)?((?:[\s,]*{NUMBER}u?)+)[)}}]?"
    declared = rf"const(?:expr \w+)? (k\w+)(?:\[\d+\])? = {value};"
    return {
        name: [float(number) for number in re.findall(NUMBER, numbers)]
        for name, numbers in re.findall(declared, text)
    }


HEADERS: dict[str, list[float]] = {}
for header in NATIVE.glob("*.h"):
    HEADERS |= constants(header.read_text("utf-8"))


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_constants_are_those_of_the_headers(file):
    ours = constants(file.read_text("utf-8"))
    shared = ours.keys() & HEADERS.keys()
    assert {name: ours[name] for name in shared} == {name: HEADERS[name] for name in shared}


def test_the_constants_are_found():
    found = set().union(*(constants(file.read_text("utf-8")) for file in FILES)) & HEADERS.keys()
    assert {"kTile", "kSH3", "kLog2MinAlpha", "kMaxAlpha", "kMinTransmittance"} <= found
    assert HEADERS["kSH2"][2] == pytest.approx(0.25 * math.sqrt(5 / math.pi))
