import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings
from tqdm import tqdm

from splatpilot.diagrams.flight.policies import POLICIES
from splatpilot.diagrams.flight.sensors import SENSORS
from splatpilot.diagrams.worlds.world_registry import WORLDS
from splatpilot.systems.common.extras import require_opengl
from splatpilot.systems.messaging.lcm_ports import open_lcm
from splatpilot.systems.visualization.live import RATE_SLIDER, LiveControls

# Without tqdm's own thread, in which garbage may be collected: Drake aborts the process where a
# Meshcat is freed by another thread than the one that made it.
tqdm.monitor_interval = 0

# The same examples in every run, and no failure because the machine was busy.
settings.register_profile("repeatable", deadline=None, derandomize=True)
settings.load_profile("repeatable")

# gsply's compiler takes longer than all that it compiles here.
os.environ["NUMBA_DISABLE_JIT"] = "1"

_SLOWEST = (
    *("tutorials", "crash", "docs", "px4", "hedgehop", "bridge", "wheel", "examples", "train"),
    *("reconstruct", "optimize", "extras", "check", "initialize", "recover", "run_study"),
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begins with the files that take longest, so that parallel workers end together."""
    order = {f"test_{name}.py": number for number, name in enumerate(_SLOWEST)}
    items.sort(key=lambda item: order.get(item.path.name, len(order)))


@pytest.fixture(scope="session", autouse=True)
def cache_of_the_tests(tmp_path_factory) -> None:
    """Keeps the user's cache out of the tests, and them out of it."""
    os.environ["XDG_CACHE_HOME"] = str(tmp_path_factory.mktemp("cache"))


@pytest.fixture(scope="session")
def opengl() -> None:
    """Skips what needs RenderEngineVtk where that cannot render."""
    try:
        require_opengl()
    except OSError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="session")
def udp_url() -> str:
    """An LCM URL on a port of this process's own; skips where multicast does not come back."""
    url = f"udpm://239.255.76.67:{20000 + os.getpid() % 20000}?ttl=0&recv_buf_size=4000000"
    try:
        open_lcm(url)
    except OSError as error:
        pytest.skip(str(error))
    return url


@pytest.fixture
def viewer(monkeypatch) -> None:
    """Opens the pages of live flights, and flies them as fast as possible."""

    def open_page(controls: LiveControls) -> None:
        controls._meshcat.SetSliderValue(RATE_SLIDER, 0.0)

    monkeypatch.setattr(LiveControls, "wait_for_viewer", open_page)


@pytest.fixture
def registered(monkeypatch) -> None:
    """Forgets policies, sensors and worlds that a test registers."""
    for registry in (POLICIES, SENSORS, WORLDS):
        monkeypatch.setattr(registry, "_entries", dict(registry._entries))


@pytest.fixture
def hedgehop(registered, monkeypatch) -> Iterator[None]:
    """Makes the example package importable; forgets its modules and entries afterwards."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "examples" / "hedgehop"))
    yield
    for name in [name for name in sys.modules if name.partition(".")[0] == "hedgehop"]:
        del sys.modules[name]
