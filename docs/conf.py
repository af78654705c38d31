"""Configures Sphinx for `make docs`, which needs no network; warnings are errors."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "_ext"))

project = "splatpilot"
author = "The splatpilot authors"
copyright = author
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "generated_pages",
    "pydrake_system",
]
exclude_patterns = ["_ext"]
myst_heading_anchors = 4
# Code blocks without a language are commands.
highlight_language = "bash"
# Single backticks in docstrings link to objects of that name, and are code otherwise.
default_role = "py:obj"
toc_object_entries = False
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_class_signature = "mixed"
napoleon_numpy_docstring = False
html_theme = "furo"
html_title = "splatpilot"
html_static_path = ["_static"]
html_css_files = ["ports.css", "report.css"]
html_show_sourcelink = False
