import pytest
from hypothesis import settings

from splatpilot.systems.opengl import require_opengl

# The same examples in every run, and no failure because the machine was busy.
settings.register_profile("repeatable", deadline=None, derandomize=True)
settings.load_profile("repeatable")


@pytest.fixture(scope="session")
def opengl() -> None:
    """Skips what needs RenderEngineVtk where that cannot render."""
    try:
        require_opengl()
    except OSError as error:
        pytest.skip(str(error))
