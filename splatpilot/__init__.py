"""Learned drone flight inside Gaussian-splat reconstructions, as Drake systems.

    import splatpilot as sp

    scenario = sp.Scenario(seed=5)
    world = sp.make_world(scenario.world, scenario.seed)
    flight = sp.fly(sp.BuildFlightDiagram(scenario, world))

The public names are listed in `__init__.pyi`. Each is imported on first use, so flying imports
neither torch nor the capture readers.
"""

from typing import Any

import lazy_loader

from splatpilot.diagrams.gym.registration import register

_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
register()


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("splatpilot")
    try:
        return _load(name)
    except ModuleNotFoundError as error:
        from splatpilot.systems.common.extras import missing_extra

        if missing := missing_extra(error, f"splatpilot.{name}"):
            raise ModuleNotFoundError(missing, name=error.name) from error
        raise
