"""Registries of policies, worlds, sensors and other plugins, built-in or of other packages."""

import functools
import importlib
import os
import re
import sys
from collections.abc import Sequence
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from splatpilot.systems.common.validation import unknown

_OTHERS = "and module:attribute of your own"
_ATTRIBUTE = re.compile(r"[\w.]+:[\w.]+")
_plugins: set[str] = set()


class Registry[Entry]:
    """Entries by name.

    An entry has a name that a caller registered, or that of an entry point of `group`, which an
    installed package announces in its pyproject.toml,

        [project.entry-points."splatpilot.policies"]
        hover = "my_package.hover:HoverConfig"

    or, without installation, is `my_package.hover:HoverConfig`. The attribute is the entry, or the
    type of its configurations, for which the module registers an entry when imported.

    Entries, of `entry_type`, with an attribute `config`, the type of their configurations, are
    found by these too. Messages call them `what`.
    """

    def __init__(self, what: str, group: str, entry_type: type[Entry]) -> None:
        self.what, self.group = what, group
        self._entry_type = entry_type
        self._entries: dict[str, Entry] = {}

    def add(self, name: str, entry: Entry) -> None:
        """Registers an entry. It replaces those of the same qualified name, as a cell of a notebook
        that runs again, or `importlib.reload`, defines them."""
        config = getattr(entry, "config", None)
        again = [
            known
            for known, other in self._entries.items()
            if (known == name or config is not None) and _qualified(other) == _qualified(entry)
        ]
        if name not in again and self._entries.get(name, entry) != entry:
            raise ValueError(f"there is a {self.what} {name!r} already; choose another name")
        for other in self.configs():
            ours, theirs = _qualified_name(config or other), _qualified_name(other)
            if ours != theirs and ours.rpartition(".")[2] == theirs.rpartition(".")[2]:
                raise ValueError(
                    f"{ours} has the name of {theirs}, and files could not tell them apart; "
                    "rename it"
                )
        self._entries |= dict.fromkeys([*again, name], entry)

    def registered(self) -> list[str]:
        """Returns the names that are registered so far."""
        return list(self._entries)

    def names(self) -> list[str]:
        """Returns the registered names, then those that installed packages announce."""
        return list(dict.fromkeys([*self._entries, *(point.name for point in self._announced())]))

    def find(self, name: str) -> Entry:
        """Returns the entry of a name, or of `module:attribute`, whose module is imported."""
        if name in self._entries:
            return self._entries[name]
        for point in self._announced():
            if point.name == name:
                return self._load(point)
        if not _ATTRIBUTE.fullmatch(name):
            raise ValueError(unknown(self.what, name, self.names(), _OTHERS))
        _search_working_directory()
        return self._load(EntryPoint(name=name, value=name, group=self.group))

    def entry_for(self, config: Any) -> Entry:
        """Returns the entry of a configuration's type, or of the nearest of its base classes."""
        for base in type(config).__mro__:
            if entry := self._by_config(base):
                return entry
        name = _qualified_name(type(config))
        if name in map(_qualified_name, self.configs()):
            raise ValueError(
                f"{name} was registered again after this configuration was made; make it again"
            )
        known = ", ".join(known.__name__ for known in self.configs())
        raise ValueError(
            f"no {self.what} has the configuration {type(config).__name__}; known are {known}, and "
            f"those that register_{self.what} adds"
        )

    def entry_name(self, entry: Entry) -> str:
        """Returns the first name of an entry."""
        return next(name for name, known in self._entries.items() if known == entry)

    def configs(self) -> list[type]:
        """Returns the types of configurations, in the order of their registration."""
        configs = [getattr(entry, "config", None) for entry in self._entries.values()]
        return list(dict.fromkeys(config for config in configs if config is not None))

    def load_announced(self) -> None:
        """Imports all entries that installed packages announce."""
        for point in self._announced():
            self._load(point)

    def modules(self) -> set[str]:
        """Returns the modules of other packages that another process must import."""
        announced = {point.module for point in self._announced()} | {"__main__"}
        modules = {config.__module__ for config in self.configs()} - announced
        return {module for module in modules if not module.startswith("splatpilot.")}

    def _by_config(self, config: Any) -> Entry | None:
        entries = self._entries.values()
        return next((entry for entry in entries if getattr(entry, "config", None) is config), None)

    def _announced(self) -> tuple[EntryPoint, ...]:
        return _entry_points(self.group, tuple(sys.path))

    def _load(self, point: EntryPoint) -> Entry:
        _plugins.add(point.module.partition(".")[0])
        try:
            value = point.load()
        except ImportError as error:
            raise ValueError(_import_error(point.module, error)) from error
        except AttributeError as error:
            raise ValueError(
                f"the {self.what} {point.name!r} is not at {point.value}: {error}"
            ) from error
        entry = value if isinstance(value, self._entry_type) else self._by_config(value)
        if entry is None:
            raise ValueError(
                f"{point.value} must be a {self._entry_type.__name__} of a {self.what}, or the "
                "type of its configurations"
            )
        self.add(point.name, entry)
        return entry


def _qualified_name(value: Any) -> str:
    return f"{value.__module__}.{value.__qualname__}"


def _qualified(entry: Any) -> tuple[str, ...]:
    """Returns the qualified name of an entry's configuration, or else of its functions."""
    config = getattr(entry, "config", None)
    parts = vars(entry).values() if config is None else [config]
    return tuple(_qualified_name(part) for part in parts if hasattr(part, "__qualname__"))


def check_name(what: str, group: str, name: str, ours: Sequence[str]) -> None:
    """Checks a name before the registry of `what` and `group`, where our own code registers `ours`,
    is imported, which may take seconds."""
    known = [*ours, *(point.name for point in _entry_points(group, tuple(sys.path)))]
    if name not in known and not _ATTRIBUTE.fullmatch(name):
        raise ValueError(unknown(what, name, known, _OTHERS))


def import_modules(names: Sequence[str]) -> None:
    """Imports modules that register entries, also from the working directory."""
    _search_working_directory()
    for name in names:
        _plugins.add(name.partition(".")[0])
        try:
            importlib.import_module(name)
        except (ImportError, SyntaxError) as error:
            raise ValueError(_import_error(name, error)) from error


def plugin_packages() -> set[str]:
    """Returns the packages, or top-level modules, that were imported for their entries."""
    return set(_plugins)


@functools.cache
def _entry_points(group: str, path: tuple[str, ...]) -> tuple[EntryPoint, ...]:
    """Returns the entry points of a group; to read them takes 50 ms for each `path`."""
    return tuple(entry_points(group=group))


def _import_error(module: str, error: Exception) -> str:
    remedy = "install it, run in its folder, or put that into PYTHONPATH"
    hint = f"; {remedy}" if isinstance(error, ImportError) else ""
    return f"the module {module} cannot be imported: {error}{hint}"


def _search_working_directory() -> None:
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
