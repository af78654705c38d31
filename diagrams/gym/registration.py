"""Registration of the environments in Gymnasium, which this module does not import."""

import importlib.util
import sys
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

_MODULE = "gymnasium.envs.registration"
_FOLDER = "splatpilot.diagrams.gym"


def register() -> None:
    """Registers `Flight-v0`, now or when Gymnasium is imported."""
    if _MODULE in sys.modules:
        _add(sys.modules[_MODULE])
    elif not any(isinstance(finder, _Finder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Finder())


def _add(registration: ModuleType) -> None:
    registration.register(
        id="Flight-v0",
        entry_point=f"{_FOLDER}.flight_env:FlightEnv",
        vector_entry_point=f"{_FOLDER}.vector_env:VectorFlightEnv",
    )


class _Finder(MetaPathFinder):
    """Registers once Gymnasium has been imported, which may be after `import splatpilot`."""

    def find_spec(self, fullname: str, path: Any, target: Any = None) -> ModuleSpec | None:
        if fullname != _MODULE:
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(fullname)
        loader: Any = spec.loader if spec else None
        if loader is not None:
            run = loader.exec_module

            def run_and_add(module: ModuleType) -> None:
                run(module)
                _add(module)

            loader.exec_module = run_and_add
        return spec
