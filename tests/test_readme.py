"""What the README shows and lists."""

import re
import tomllib
from pathlib import Path

import numpy as np

README = Path(__file__).parents[1] / "README.md"


def test_python_code_flies():
    """The Python there flies, builds a diagram of systems in fewer than 30 lines with one import of
    ours, flies to its goal and sees."""
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    assert sum(bool(line.strip()) for line in blocks[1].splitlines()) < 30
    assert blocks[1].count("splatpilot") == 1
    names: dict = {}
    for block in blocks:
        exec(block, names)
    p_WS, p_WG = names["world"].p_WS, names["world"].p_WG
    assert np.linalg.norm(names["p_WB"] - p_WG) < 0.5 * np.linalg.norm(p_WS - p_WG)
    assert names["image"].shape == (240, 320, 4)
    assert names["image"][..., :3].std() > 20


def test_extras_are_those_of_the_package():
    """The table of extras has each that users may install, and no other."""
    table = re.search(r"\| extra \|.*?\n\n", README.read_text(), re.DOTALL)
    assert table is not None
    project = tomllib.loads((README.parent / "pyproject.toml").read_text())["project"]
    extras = set(project["optional-dependencies"]) - {"dev"}
    assert set(re.findall(r"^\| `(\w+)`", table[0], re.MULTILINE)) == extras
