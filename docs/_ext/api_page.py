"""Writes the page `api`: the public names, and every LeafSystem of `systems/`."""

import importlib
import inspect
import pkgutil
from collections.abc import Iterator
from typing import Any

from pydrake.systems.framework import LeafSystem

import splatpilot
import splatpilot.systems


def public_names() -> list[str]:
    """Returns the public names, `sp.NAME` after `import splatpilot as sp`."""
    return [name for name in splatpilot.__all__ if name != "__version__"]


def leaf_systems() -> Iterator[str]:
    """Yields the paths of the LeafSystems of `systems/` without a public name."""
    public = {getattr(splatpilot, name) for name in public_names()}
    for module in pkgutil.walk_packages(splatpilot.systems.__path__, "splatpilot.systems."):
        for name, member in inspect.getmembers(importlib.import_module(module.name)):
            own = inspect.isclass(member) and member.__module__ == module.name
            if own and issubclass(member, LeafSystem) and member not in public:
                if not name.startswith("_"):
                    yield f"{module.name}.{name}"


def page() -> str:
    """Returns the sections of the page in Markdown."""
    parts = ["## Public names\n"]
    for name in public_names():
        member = getattr(splatpilot, name)
        if "𝓣" in member.__name__:
            parts.append(_template_entry(name, member))
        else:
            kind = "class" if inspect.isclass(member) else "function"
            parts.append(_entry(f"sp.{name}", kind, f"splatpilot.{name}"))
    parts.append("## Other systems\n")
    parts += [_entry(name.rpartition(".")[2], "class", name) for name in leaf_systems()]
    return "\n".join(parts)


def _template_entry(name: str, system: Any) -> str:
    """Returns the section of a template system, of the signature of `_construct`.

    Its name includes the scalar type, so autodoc would show an alias.
    """
    system.__name__ = name
    parameters = inspect.signature(system._construct).parameters.items()
    shown = ", ".join(str(p) for key, p in parameters if key not in ("self", "converter"))
    return _entry(f"sp.{name}", "class", f"splatpilot.{name}({shown})", members=False)


def _entry(heading: str, kind: str, name: str, members: bool = True) -> str:
    option = "   :members:\n" if kind == "class" and members else ""
    return f"### {heading}\n\n```{{eval-rst}}\n.. auto{kind}:: {name}\n{option}```\n"
