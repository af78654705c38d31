"""Defines the directive `pydrake_system` of Drake's docstrings, a table of ports."""

from html import escape

import yaml
from docutils import nodes
from docutils.parsers.rst import Directive
from sphinx.application import Sphinx


class PydrakeSystem(Directive):
    """Renders YAML with `name`, `input_ports` and `output_ports` as a table of three columns."""

    has_content = True

    def run(self) -> list[nodes.Node]:
        system = yaml.safe_load("\n".join(self.content))
        inputs = "<br>".join(f"{escape(port)} &rarr;" for port in system.get("input_ports", []))
        outputs = "<br>".join(f"&rarr; {escape(port)}" for port in system.get("output_ports", []))
        html = (
            f'<table class="ports"><tr><td>{inputs}</td>'
            f'<td class="name">{escape(system["name"])}</td><td>{outputs}</td></tr></table>'
        )
        return [nodes.raw("", html, format="html")]


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_directive("pydrake_system", PydrakeSystem)
    return {"parallel_read_safe": True}
