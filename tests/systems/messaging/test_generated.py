import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[3]
TYPES = sorted((ROOT / "lcmtypes").glob("*.lcm"))


def python_in(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in folder.glob("*.py")}


def test_generated_python_is_that_of_the_types(tmp_path):
    generator = Path(sys.executable).with_name("lcm-gen")
    subprocess.run([generator, "--python", "--ppath", tmp_path, *TYPES], check=True)
    generated = python_in(ROOT / "systems" / "messaging" / "generated")
    assert generated == python_in(tmp_path / "splatpilot")
    assert len(generated) == len(TYPES) + 1  # And __init__.py.
