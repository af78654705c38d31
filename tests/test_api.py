import subprocess
import sys
from importlib.metadata import version

import splatpilot as sp

IMPORTS = """
import os, sys

before = dict(os.environ)
import splatpilot as sp

heavy = {"pydrake", "numpy", "torch", "scipy", "cv2", "matplotlib", "pycolmap"} & set(sys.modules)
assert not heavy and os.environ == before
import splatpilot.diagrams.flight.fly, splatpilot.analysis.view

sp.Scenario, sp.make_world, sp.BuildFlightDiagram, sp.fly, sp.SplatCamera, sp.Esdf
assert not {"torch", "pycolmap"} & set(sys.modules)
"""


def test_every_public_name_exists():
    for name in sp.__all__:
        assert getattr(sp, name) is not None
        assert name in dir(sp) or name == "__version__"
    assert sp.__version__ == version("splatpilot")


def test_importing_loads_nothing_heavy_and_flying_no_extras():
    subprocess.run([sys.executable, "-c", IMPORTS], check=True)
