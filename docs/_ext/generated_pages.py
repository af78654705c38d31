"""The pages whose content is read from the source when the site is built."""

import api_page
import configuration_page
import examples_page
from sphinx.application import Sphinx

PAGES = {
    "api": api_page.page,
    "configuration": configuration_page.page,
    "examples": examples_page.page,
}
"""Behind what stands in the page of this name comes what the function returns."""


def _add(app: Sphinx, docname: str, source: list[str]) -> None:
    if docname in PAGES:
        source[0] += "\n" + PAGES[docname]()


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("source-read", _add)
    return {"parallel_read_safe": True}
