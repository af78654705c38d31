import sys

import numpy as np
import pytest

from splatpilot.analysis.commands.main import main
from splatpilot.training.policies.trainer_registry import TRAINERS

PACKAGE = """
from tiny_trainer import TinyTrainer, TinyTraining

from splatpilot import register_trainer


class MeanTraining(TinyTraining):
    pass


register_trainer("mean", MeanTraining, TinyTrainer)
"""


@pytest.mark.parametrize("installed", [True, False])
def test_trainer_of_another_package_trains_by_the_same_command(installed, tmp_path, monkeypatch):
    name = "mean_package" if installed else "mean_module"
    (tmp_path / f"{name}.py").write_text(PACKAGE.replace("mean", name).replace("Mean", name))
    if installed:
        about = tmp_path / f"{name}-1.0.dist-info"
        about.mkdir()
        (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        point = f"[splatpilot.trainers]\n{name} = {name}:{name}Training\n"
        (about / "entry_points.txt").write_text(point)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(TRAINERS, "_entries", dict(TRAINERS._entries))
    out = tmp_path / "out"
    trainer = name if installed else f"{name}:{name}Training"
    assert main(["train", trainer, "--out", str(out), "--set", "seed=3"]) == 0
    with np.load(out / "diffaero.npz") as weights:
        assert "head.weight" in weights
    assert "seed: 3" in (out / "config.yaml").read_text()
    sys.modules.pop(name)


def test_policy_without_a_trainer_is_refused_with_the_known_ones(tmp_path, capsys):
    assert main(["train", "planner", "--out", str(tmp_path / "out")]) == 1
    message = capsys.readouterr().err
    assert "no trainer 'planner'" in message
    assert all(name in message for name in ("diffaero", "depthnav", "agile_autonomy"))
    assert not (tmp_path / "out").exists()
