"""Whether Drake's OpenGL renderer works."""

import pytest

from splatpilot.systems.opengl import require_opengl


def test_missing_driver_is_an_error_that_says_what_to_install(opengl, monkeypatch):
    """Without any EGL driver, the answer is an error and not the end of the process."""
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_FILENAMES", "/nonexistent")
    monkeypatch.setenv("DISPLAY", "")
    require_opengl.cache_clear()
    try:
        with pytest.raises(OSError, match="apt install libegl1"):
            require_opengl()
    finally:
        require_opengl.cache_clear()
