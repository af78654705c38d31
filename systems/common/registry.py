"""Kinds of one thing, ours and those of other packages, by name."""

import functools
import importlib
import os
import re
import sys
from collections.abc import Iterator, Sequence
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from splatpilot.systems.common.validation import unknown

_OURS = "splatpilot."
_OTHER = "and module:attribute of your own"
_others: set[str] = set()
_ATTRIBUTE = re.compile(r"[\w.]+:[\w.]+")


class Registry[Kind]:
    """
    What there is of one thing: policies, worlds, sensors and so on.

    A kind is there under a name that our own code or a caller has given it, under the name of an
    entry point of `group`, which an installed package announces in its pyproject.toml,

        [project.entry-points."splatpilot.policies"]
        hover = "my_package.hover:HoverConfig"

    and, where nothing is installed, as `my_package.hover:HoverConfig`. What is behind the colon is
    the kind, or the type of its configuration, for which the module registers a kind when imported.

    Kinds with an attribute `config`, the type of their configurations, are found by these too.
    """

    def __init__(self, what: str, group: str, kind: type[Kind]):
        """
        Args:
            what: the thing, for messages.
            group: of the entry points.
            kind: the type of the kinds.
        """
        self.what, self.group = what, group
        self._kind = kind
        self._kinds: dict[str, Kind] = {}

    def add(self, name: str, kind: Kind) -> None:
        """
        Registers a kind; the same one again changes nothing.

        Raises:
            ValueError: if the name, or that of the type of its configurations, is another kind's.
        """
        if name in self._kinds and self._kinds[name] != kind:
            raise ValueError(f"there is a {self.what} {name!r} already; choose another name")
        config = getattr(kind, "config", None)
        for other in self._configs():
            if config is not None and config.__name__ == other.__name__ and config is not other:
                raise ValueError(
                    f"{config.__module__}.{config.__name__} has the name of {other.__module__}."
                    f"{other.__name__}, and files could not tell them apart; rename it"
                )
        self._kinds[name] = kind

    def registered(self) -> list[str]:
        """The names of the kinds that are registered by now."""
        return list(self._kinds)

    def names(self) -> list[str]:
        """The names of all kinds: those registered, then those that installed packages announce."""
        return list(dict.fromkeys([*self._kinds, *(point.name for point in self._announced())]))

    def find(self, name: str) -> Kind:
        """
        The kind of a name, or of `module:attribute`, whose module is imported.

        Raises:
            ValueError: if there is none; the message lists what there is.
        """
        if name in self._kinds:
            return self._kinds[name]
        for point in self._announced():
            if point.name == name:
                return self._load(point)
        if _ATTRIBUTE.fullmatch(name):
            _look_here_too()
            return self._load(EntryPoint(name=name, value=name, group=self.group))
        raise ValueError(unknown(self.what, name, self.names(), _OTHER))

    def kind_of(self, config: Any) -> Kind:
        """
        The kind whose configuration this is, or the nearest of its base classes.

        Raises:
            ValueError: if there is none; the message lists what there is.
        """
        for type_ in type(config).__mro__:
            for kind in self._kinds.values():
                if getattr(kind, "config", None) is type_:
                    return kind
        known = ", ".join(config.__name__ for config in self._configs())
        raise ValueError(
            f"no {self.what} has the configuration {type(config).__name__}; known are {known}, and "
            f"what register_{self.what} is told"
        )

    def name_of(self, kind: Kind) -> str:
        """The first name that a kind is registered under."""
        return next(name for name, known in self._kinds.items() if known == kind)

    def configs(self, tags: set[str]) -> list[type]:
        """
        The types of configurations, in the order of their registration.

        Args:
            tags: names of types that are looked for: if one is unknown, the packages that announce
                kinds are imported.
        """
        if tags - {config.__name__ for config in self._configs()}:
            for point in self._announced():
                self._load(point)
        return list(self._configs())

    def modules(self) -> set[str]:
        """The modules of others that must be imported for all kinds to be found again."""
        announced = {point.module for point in self._announced()}
        modules = {config.__module__ for config in self._configs()}
        return {m for m in modules - announced if not m.startswith(_OURS) and m != "__main__"}

    def _configs(self) -> Iterator[type]:
        for kind in self._kinds.values():
            config = getattr(kind, "config", None)
            if config is not None:
                yield config

    def _announced(self) -> Iterator[EntryPoint]:
        yield from _installed(self.group, tuple(sys.path))

    def _load(self, point: EntryPoint) -> Kind:
        _others.add(point.module.partition(".")[0])
        try:
            value = point.load()
        except ImportError as error:
            raise ValueError(_not_imported(point.module, error)) from error
        except AttributeError as error:
            raise ValueError(
                f"the {self.what} {point.name!r} is not at {point.value}: {error}"
            ) from error
        if isinstance(value, self._kind):
            self.add(point.name, value)
            return value
        for kind in self._kinds.values():
            if getattr(kind, "config", None) is value:
                self.add(point.name, kind)
                return kind
        raise ValueError(
            f"{point.value} is no {self.what}; it must be a {self._kind.__name__}, or the type of "
            f"the configurations of one that its module registers"
        )


def check_name(what: str, group: str, name: str, ours: Sequence[str]) -> None:
    """
    Checks a name before the registry that has it is imported, which may take seconds.

    Args:
        what, group: of the registry.
        ours: the names that our own code registers there.

    Raises:
        ValueError: if no kind will have the name; the message lists what there is.
    """
    announced = [point.name for point in _installed(group, tuple(sys.path))]
    if name not in (*ours, *announced) and not _ATTRIBUTE.fullmatch(name):
        raise ValueError(unknown(what, name, [*ours, *announced], _OTHER))


@functools.cache
def _installed(group: str, path: tuple[str, ...]) -> tuple[EntryPoint, ...]:
    """The entry points of a group that packages on the `path` announce, whose files take 50 ms to
    read."""
    return tuple(entry_points(group=group))


def import_modules(names: Sequence[str]) -> None:
    """
    Imports modules that register kinds; those in the working directory are found too.

    Raises:
        ValueError: if one cannot be imported.
    """
    _look_here_too()
    for name in names:
        _others.add(name.partition(".")[0])
        try:
            importlib.import_module(name)
        except SyntaxError as error:
            raise ValueError(f"the module {name} cannot be imported: {error}") from error
        except ImportError as error:
            raise ValueError(_not_imported(name, error)) from error


def _not_imported(module: str, error: ImportError) -> str:
    return (
        f"the module {module} cannot be imported: {error}; install it, run in its folder, or put "
        "that into PYTHONPATH"
    )


def packages_of_others() -> set[str]:
    """The packages, or modules outside of any, that were imported for what they register."""
    return set(_others)


def _look_here_too() -> None:
    """Lets modules that were named be found in the working directory, after all other places."""
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
