from pathlib import Path

from nanobind.stubgen import StubGen

from splatpilot import _native

STUB = Path(__file__).parents[2] / "splatpilot" / "_native.pyi"


def test_stub_is_what_the_module_gives():
    generator = StubGen(_native)
    generator.put(_native)
    assert generator.get() == STUB.read_text()
