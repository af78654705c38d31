"""Writes the page `api`: the public names, and every LeafSystem of `systems/`."""

import importlib
import inspect
import pkgutil
from collections.abc import Iterator

from pydrake.systems.framework import LeafSystem
from pydrake.systems.scalar_conversion import TemplateSystem

import splatpilot
import splatpilot.systems


def public_names() -> list[str]:
    """Returns the public names, `sp.NAME` after `import splatpilot as sp`, without templates."""
    names = [name for name in splatpilot.__all__ if name != "__version__"]
    return [name for name in names if not isinstance(getattr(splatpilot, name), TemplateSystem)]


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
        kind = "class" if inspect.isclass(getattr(splatpilot, name)) else "function"
        parts.append(_entry(f"sp.{name}", kind, f"splatpilot.{name}"))
    parts.append("## Other systems\n")
    parts += [_entry(name.rpartition(".")[2], "class", name) for name in leaf_systems()]
    return "\n".join(parts)


def _entry(heading: str, kind: str, name: str, members: bool = True) -> str:
    option = "   :members:\n" if kind == "class" and members else ""
    return f"### {heading}\n\n```{{eval-rst}}\n.. auto{kind}:: {name}\n{option}```\n"
