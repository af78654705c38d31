"""Pages of HTML that need no other file."""

import base64
import math
from html import escape

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1c1e21; max-width: 1360px; margin: 2em auto;
       padding: 0 1em; }
h1 { font-size: 1.7em; } h2 { font-size: 1.25em; margin-top: 2em; }
table { display: block; overflow-x: auto; border-collapse: collapse;
        font-variant-numeric: tabular-nums; margin: .6em 0; }
th, td { padding: .25em .5em; white-space: nowrap; text-align: right;
         border-bottom: 1px solid #e3e5e8; }
th:first-child, td:first-child { text-align: left; }
th { background: #f4f5f7; font-weight: 600; white-space: normal; }
img { max-width: 100%; } code { background: #f4f5f7; padding: .1em .3em; font-size: 13px; }
details { margin: .3em 0; } summary { cursor: pointer; }
.note { color: #555; } .warn { background: #fff4d6; padding: .5em .8em; border-radius: 4px; }
"""


def page(title: str, sections: list[str]) -> str:
    """A whole page of sections in HTML."""
    body = "\n".join(sections)
    return (
        f'<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}'
        f"</title><style>{_STYLE}</style></head><body>{body}</body></html>\n"
    )


def table(header: list[str], rows: list[list[str]]) -> str:
    """A table of cells in HTML."""
    head = "".join(f"<th>{cell}</th>" for cell in header)
    body = "".join("<tr>" + "".join(f"<td>{c}</td>" for c in row) + "</tr>" for row in rows)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def image(png: bytes, alt: str) -> str:
    """A picture, inside the page."""
    encoded = base64.b64encode(png).decode()
    return f'<img src="data:image/png;base64,{encoded}" alt="{escape(alt)}">'


def number(value: float, form: str) -> str:
    """A number in the format `form`, a dash if it is not finite."""
    return format(value, form) if math.isfinite(value) else "–"
