"""Learned drone flight inside Gaussian-splat reconstructions of real places, as Drake systems.

    import splatpilot as sp

    scenario = sp.Scenario(seed=5)
    world = sp.make_world(scenario.world, scenario.seed)
    flight = sp.fly(sp.BuildFlightDiagram(scenario, world), scenario, world)

The public names are those of `__init__.pyi`, each loaded when it is first used: flying imports
neither torch nor what reads captures.
"""

from typing import Any

import lazy_loader

from splatpilot.systems.common.numpy_kernels import fix_numpy_kernels

fix_numpy_kernels()
_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("splatpilot")
    try:
        return _load(name)
    except ModuleNotFoundError as error:
        from splatpilot.systems.common.extras import missing_extra

        missing = missing_extra(error, f"splatpilot.{name}")
        if missing is None:
            raise
        raise ModuleNotFoundError(missing, name=error.name) from error
