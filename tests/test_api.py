import subprocess
import sys

import splatpilot as sp


def run(program: str) -> str:
    answer = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    return answer.stdout.strip()


def test_every_public_name_exists():
    for name in sp.__all__:
        assert getattr(sp, name) is not None
        assert name in dir(sp) or name == "__version__"


def test_importing_loads_nothing_heavy():
    heavy = "{'pydrake', 'numpy', 'torch', 'scipy', 'cv2', 'matplotlib', 'pycolmap'}"
    assert run(f"import sys, splatpilot; print({heavy} & set(sys.modules))") == "set()"


def test_flying_and_looking_need_no_extras():
    names = "sp.Scenario, sp.make_world, sp.BuildFlightDiagram, sp.fly, sp.SplatCamera, sp.Esdf"
    modules = "splatpilot.diagrams.flight.fly, splatpilot.analysis.view"
    found = "{'torch', 'pycolmap'} & set(sys.modules)"
    assert run(f"import sys, splatpilot as sp, {modules}; {names}; print({found})") == "set()"


def test_version_is_the_distributions():
    from importlib.metadata import version

    assert sp.__version__ == version("splatpilot")
