"""The message types and their Python."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
TYPES = sorted((ROOT / "lcmtypes").glob("*.lcm"))
GENERATED = ROOT / "systems" / "messaging" / "generated"
LCM_GEN = Path(sys.executable).with_name("lcm-gen")


@pytest.fixture(scope="module")
def regenerated(tmp_path_factory) -> Path:
    """What the lcm package's own lcm-gen writes for our message types."""
    folder = tmp_path_factory.mktemp("generated")
    subprocess.run([LCM_GEN, "--python", "--ppath", folder, *TYPES], check=True)
    return folder / "splatpilot"


def python_in(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in folder.glob("*.py")}


def test_generated_python_is_that_of_the_types(regenerated):
    assert python_in(GENERATED) == python_in(regenerated)
    assert len(python_in(GENERATED)) == len(TYPES) + 1  # And __init__.py.


@pytest.mark.parametrize("path", TYPES, ids=lambda path: path.stem)
def test_every_message_says_when_and_which(path):
    text = path.read_text()
    assert text.count("struct") == 1
    assert text.index("drake.lcmt_header header;") < text.index(";", text.index("struct")) + 1
