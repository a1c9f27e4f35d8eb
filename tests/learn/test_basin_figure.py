"""The interactive figure of docs/learn/initialisation.md, in a real browser."""

from pathlib import Path

import pytest

from ..browser import Browser, Page, chromium

ROOT = Path(__file__).resolve().parents[2]

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(chromium() is None, reason="needs Chromium"),
]


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """The figure alone, opened as a file, without animation."""
    static = ROOT / "docs" / "static"
    file = tmp_path_factory.mktemp("figure") / "figure.html"
    file.write_text(
        f'<!doctype html><meta charset="utf-8"><link rel="stylesheet" href="{static}/site.css">'
        '<body><div id="basin"></div><div id="basin-picture">picture</div>'
        f'<script src="{static}/basin.js"></script>'
    )
    with Browser(390, 900) as browser:
        page = browser.open(file.as_uri())
        reduced = [{"name": "prefers-reduced-motion", "value": "reduce"}]
        page.call("Emulation.setEmulatedMedia", features=reduced)
        yield page
        assert not page.errors


def choose(page: Page, name: str, value: str) -> None:
    page.evaluate(
        f"""(() => {{ const field = document.querySelector('[name={name}]');
        field.value = '{value}'; field.dispatchEvent(new Event('change')); }})()"""
    )


def tick(page: Page, name: str, on: bool) -> None:
    page.evaluate(
        f"""(() => {{ const field = document.querySelector('[name={name}]');
        if (field.checked !== {str(on).lower()}) field.click(); }})()"""
    )


def value(page: Page, handle: str) -> float:
    script = f"document.querySelector('[data-handle={handle}]').getAttribute('aria-valuenow')"
    return float(page.evaluate(script))


def place(page: Page, target: float) -> None:
    """Move the first Gaussian with the arrow keys, from a new start."""
    page.evaluate("document.querySelector('[name=back]').click()")
    page.evaluate("document.querySelector('[data-handle=position0]').focus()")
    for _ in range(100):
        now = value(page, "position0")
        if abs(now - target) < 0.2:
            return
        page.key("ArrowRight" if now < target else "ArrowLeft")
    raise AssertionError("the keys do not move the Gaussian")


def run(page: Page) -> str:
    page.evaluate("document.querySelector('[name=run]').click()")
    return str(page.wait_for("document.getElementById('basin').dataset.result"))


def test_it_replaces_the_picture_and_fits_on_a_phone(page):
    assert page.evaluate("document.getElementById('basin-picture') === null")
    assert page.evaluate("document.documentElement.scrollWidth <= 390")


def test_gradient_descent_arrives_from_near_and_not_from_far(page):
    choose(page, "count", "1")
    place(page, -2.5)
    assert run(page) == "found"
    assert abs(value(page, "position0")) < 0.01
    assert value(page, "width0") == pytest.approx(1, abs=0.01)
    place(page, -6)
    assert run(page) == "not found"
    # Blurring the target first makes the basin wider.
    tick(page, "blur", True)
    place(page, -6)
    assert run(page) == "found"
    tick(page, "blur", False)
