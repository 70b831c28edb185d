"""A report as one HTML page that refers to nothing outside itself."""

from __future__ import annotations

import re
from collections.abc import Sequence
from html import escape
from typing import Final

from egovcp_experiment.report.document import Plot, Report, Table

_STYLE: Final = """
body { font: 15px/1.45 sans-serif; max-width: 60em; margin: 2em auto; padding: 0 1em; color: #222; }
table { border-collapse: collapse; font-size: 13px; margin: 0.5em 0 1.5em; }
td, th { border-bottom: 1px solid #ddd; padding: 2px 10px 2px 0; text-align: left; }
td { font-variant-numeric: tabular-nums; }
code { font-size: 12px; overflow-wrap: anywhere; }
figure { margin: 1em 0; } figcaption { color: #555; font-size: 13px; }
svg { max-width: 100%; height: auto; }
.shows { background: #f4f4ee; padding: 0.5em 1.5em; }
"""


def page(report: Report, origin: Sequence[str | Table]) -> str:
    """The whole page.

    Args:
        report: what was found.
        origin: how it was made, folded away below the rest.
    """
    shows = "".join(f"<li>{_text(line)}</li>" for line in report.shows)
    parts = "\n".join(_part(part) for part in report.parts)
    made = "\n".join(_part(part) for part in origin)
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f"<title>{escape(report.title)}</title><style>{_STYLE}</style></head><body>\n"
        f"<h1>{escape(report.title)}</h1>\n"
        f'<div class="shows"><b>What it shows</b><ul>{shows}</ul></div>\n{parts}\n'
        f"<details><summary>How each number was made</summary>\n{made}\n</details>\n"
        "</body></html>\n"
    )


def _part(part: str | Table | Plot) -> str:
    if isinstance(part, Table):
        return _table(part)
    if isinstance(part, Plot):
        caption = escape(part.caption)
        return f"<figure>{part.svg}<figcaption>{caption}</figcaption></figure>"
    return f"<p>{_text(part)}</p>"


def _table(part: Table) -> str:
    head = "".join(f"<th>{_text(cell)}</th>" for cell in part.head)
    rows = "\n".join(
        f"<tr>{''.join(f'<td>{_text(cell)}</td>' for cell in row)}</tr>" for row in part.rows
    )
    title = f"<h3>{escape(part.title)}</h3>\n" if part.title else ""
    return f"{title}<table><tr>{head}</tr>\n{rows}</table>"


def _text(text: str) -> str:
    """Escaped, with `code` and **bold** of Markdown."""
    bold = re.sub(r"\*\*(.+?)\*\*", r"<b>\1</b>", escape(text))
    return re.sub(r"`(.+?)`", r"<code>\1</code>", bold)
