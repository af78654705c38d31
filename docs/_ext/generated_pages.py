"""Generates pages from the source when the site is built."""

import api_page
import configuration_page
import examples_page
from sphinx.application import Sphinx

PAGES = {
    "api": api_page.page,
    "configuration": configuration_page.page,
    "examples": examples_page.page,
}
"""Functions whose result is appended to the page of this name."""


def _add(app: Sphinx, docname: str, source: list[str]) -> None:
    if docname in PAGES:
        source[0] += "\n" + PAGES[docname]()


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("source-read", _add)
    app.connect("autodoc-skip-member", _skip)
    return {"parallel_read_safe": True}


def _skip(app: Sphinx, what: str, name: str, member: object, skip: bool, options: object) -> bool:
    """Skips fields of named tuples, whose classes describe them."""
    return skip or (member.__doc__ or "").startswith("Alias for field number")
