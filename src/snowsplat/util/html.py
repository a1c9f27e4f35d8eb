"""Self-contained HTML pages for reports, with a common style in light and dark.

The pages are also well-formed XML. Arguments named ``html`` are markup. Any other text, such as
file names, must be escaped with `text`.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

from PIL import Image

from snowsplat.util.safe_json import printable

#: The script with which pages tell in Chinese what the program says in English.
CHINESE = Path(__file__).with_name("chinese.js")

_STYLE = """
:root { color-scheme: light dark; --bg: light-dark(#fbfaf7, #14171b);
  --card: light-dark(#fff, #1c2127); --ink: light-dark(#20252c, #e6e9ed);
  --soft: light-dark(#5d6774, #98a2ae); --line: light-dark(#e3e0d8, #2e353d);
  --accent: light-dark(#a35808, #ffb454); --bad: light-dark(#b3261e, #ff8a80); }
* { box-sizing: border-box; }
body { margin: 0; background: var(--bg); color: var(--ink); line-height: 1.5;
  font-family: system-ui, -apple-system, "Segoe UI", sans-serif; }
main { max-width: 1120px; margin: 0 auto; padding: 32px 20px 64px; }
h1 { font-size: 1.7rem; margin: 0; overflow-wrap: anywhere; }
h2 { font-size: 1.05rem; margin: 36px 0 10px; }
p { margin: 6px 0; } p, li { overflow-wrap: anywhere; }
.soft, figcaption { color: var(--soft); } .bad { color: var(--bad); }
.cards { display: flex; flex-wrap: wrap; gap: 12px; margin: 22px 0; }
.card { flex: 1 1 150px; background: var(--card); border: 1px solid var(--line);
  border-radius: 8px; padding: 12px 16px; }
.card b { display: block; font-size: 1.6rem; font-weight: 600; font-variant-numeric: tabular-nums; }
figure { margin: 0; min-width: 0; } figcaption { font-size: .9rem; margin-top: 4px; }
table { border-collapse: collapse; width: 100%; font-size: .92rem; }
th, td { text-align: left; padding: 5px 14px 5px 0; border-bottom: 1px solid var(--line);
  vertical-align: top; overflow-wrap: break-word; }
th { color: var(--soft); font-weight: 500; } .facts th { width: 16em; }
.names td { overflow-wrap: anywhere; }
code, pre { font-family: ui-monospace, Menlo, Consolas, monospace; font-size: .9em; }
pre { background: var(--card); border: 1px solid var(--line); border-radius: 8px;
  padding: 10px 14px; overflow-x: auto; margin: 8px 0; }
.bar { display: inline-block; width: calc(var(--share) * min(35vw, 400px)); height: .7em;
  border-radius: 2px; background: var(--accent); }
summary { cursor: pointer; color: var(--soft); } ol { margin: 6px 0; padding-left: 1.4em; }
.language { position: absolute; top: 8px; right: 12px; font: inherit; font-size: .85rem;
  color: var(--soft); background: none; border: 0; cursor: pointer; }
.wide { overflow-x: auto; } [role="button"] { cursor: zoom-in; }
dialog { max-width: none; max-height: none; border: 0; padding: 0; background: none; color: #fff;
  text-align: center; cursor: zoom-out; } dialog::backdrop { background: #000d; }
dialog img { display: block; width: 96vw; height: calc(96vh - 3em); object-fit: contain; }
@media (max-width: 600px) { main { padding: 20px 14px 48px; } .card { flex-basis: 130px; }
  .card b { font-size: 1.35rem; } th, td { padding-right: 8px; } .facts th { width: 40%; }
  .bar { width: calc(var(--share) * 9vw); } }
"""

# Each picture is a button that opens it as large as it is stored; Escape or a click closes it, and
# the arrow keys show the next one. Without scripts, the pictures remain small. The script is part
# of a well-formed document, so it contains neither "<" nor "&".
_LARGE = """
const pictures = [...document.querySelectorAll('main img')];
const dialog = document.body.appendChild(document.createElement('dialog'));
const large = dialog.appendChild(new Image());
large.alt = '';
const name = dialog.appendChild(document.createElement('p'));
let shown = 0;
const show = (number) => {
  shown = (number + pictures.length) % pictures.length;
  large.src = pictures[shown].src;
  name.textContent = large.alt = pictures[shown].alt;
  if (!dialog.open) dialog.showModal();
};
pictures.forEach((picture, number) => {
  picture.tabIndex = 0;
  picture.setAttribute('role', 'button');
  picture.onclick = () => show(number);
  picture.onkeydown = (event) => {
    if (!['Enter', ' '].includes(event.key)) return;
    event.preventDefault();
    show(number);
  };
});
dialog.onclick = () => dialog.close();
dialog.onkeydown = (event) => {
  const by = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
  if (by) show(shown + by);
};
"""


def page(title: str, html: Iterable[str], style: str = "") -> str:
    """A complete page.

    Args:
        title: plain text.
        html: the parts of the page, from top to bottom; empty parts are skipped.
        style: additional CSS.
    """
    body = "\n".join(filter(None, html))
    scripts = (CHINESE, CHINESE.with_name("chinese_report.js"))
    chinese = "".join(script.read_text(encoding="utf-8") for script in scripts)
    script = (_LARGE if "<img " in body else "") + chinese
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"/>'
        '<meta name="viewport" content="width=device-width, initial-scale=1"/>'
        f'<title>{text(title)}</title><link rel="icon" href="data:,"/>'
        f"<style>{_STYLE}{style}</style></head>\n"
        f"<body><main>\n{body}\n</main><script>{script}</script></body></html>\n"
    )


def cards(html: Iterable[tuple[str, str]]) -> str:
    """A row of cards from pairs (value, label): the value in large type, the label below."""
    inner = "".join(f'<div class="card"><b>{value}</b>{label}</div>' for value, label in html)
    return f'<div class="cards">{inner}</div>'


def table(heads: Sequence[str], html: Iterable[Sequence[str]], kind: str = "plain") -> str:
    """A table.

    Args:
        heads: column headers. If empty, the first cell of each row is the header of the row.
        html: the rows.
        kind: the CSS class; with "names", long words may break anywhere.
    """
    if not heads:
        lines = (f"<tr><th>{row[0]}</th>{_cells(row[1:])}</tr>" for row in html)
        return f"<table class='facts'><tbody>{''.join(lines)}</tbody></table>"
    top = "".join(f"<th>{head}</th>" for head in heads)
    body = "".join(f"<tr>{_cells(row)}</tr>" for row in html)
    rows = f"<thead><tr>{top}</tr></thead><tbody>{body}</tbody>"
    return f"<div class='wide'><table class='{kind}'>{rows}</table></div>"


def _cells(html: Sequence[str]) -> str:
    return "".join(f"<td>{cell}</td>" for cell in html)


def bar(share: float) -> str:
    """A horizontal bar for a table cell; ``share`` is its length relative to the longest bar."""
    share = max(0.01, min(1.0, share))
    return f'<span class="bar" style="--share:{share:.3f}"></span>'


def picture(image: Image.Image, alt: str, quality: int = 75) -> str:
    """An RGB image as an <img> element with embedded JPEG data, which opens large in a `page`.

    The style sheet of the page says how large it is at first.
    """
    data = io.BytesIO()
    image.save(data, "JPEG", quality=quality)
    source = base64.b64encode(data.getvalue()).decode("ascii")
    return f'<img src="data:image/jpeg;base64,{source}" alt="{text(alt)}" title="{text(alt)}"/>'


def text(value: object) -> str:
    """``value`` as escaped text, for elements and for quoted attributes."""
    return escape(printable(str(value)))
