"""Writes the page `examples`: each file of `examples/`."""

from pathlib import Path

EXAMPLES = Path(__file__).parents[2] / "examples"


def page() -> str:
    """Returns the sections of the page in Markdown."""
    parts = []
    for file in sorted(EXAMPLES.glob("*.py")):
        heading = file.read_text().removeprefix('"""').partition("\n")[0]
        parts.append(
            f"## {heading.rstrip('.')}\n\n```{{literalinclude}} ../examples/{file.name}\n"
            f":language: python\n:caption: examples/{file.name}\n```\n"
        )
    return "\n".join(parts)
