import csv
from dataclasses import asdict, replace
from itertools import pairwise

import cv2
import numpy as np

from splatpilot.analysis.commands.main import main
from splatpilot.analysis.reconstruction import ablation, measure_scene
from splatpilot.analysis.reconstruction.ablation import ARMS, AblationResult, arm_config
from splatpilot.analysis.reconstruction.measure_scene import SceneMetrics
from splatpilot.diagrams.worlds.scene_folder import read_scene_metadata
from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.metrics import ViewMetrics


def test_ablation_end_to_end(room, set_fields, capsys, monkeypatch):
    monkeypatch.setattr(measure_scene, "_write_views", lambda *_: None)  # which take seconds
    settings = ("iterations=4", "threads=1", "initial_gaussians=500", "voxel_size=0.5")
    out, settings = room.folder / "out", set_fields(*settings, "image_width=32")
    ablate = ["scene", "ablate", "room", "--out", str(out), *settings]
    assert main(ablate) == 0
    printed = capsys.readouterr().out
    assert "paper    3DGS + depth term" in printed
    paper = "| paper | 2DGS from points, photometric | 29.07 | 0.8656 | 0.228 | 1.466 | 13.00% |"
    assert paper in (out / "ablation.md").read_text()
    with open(out / "ablation.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    paper_arms = ["3dgs_points", "3dgs_depth_term", "2dgs_points", "2dgs_depth_term"]
    assert [row["arm"] for row in rows] == [*(arm.key for arm in ARMS), *paper_arms]
    for arm, row in zip(ARMS, rows, strict=False):
        metadata = read_scene_metadata(out / "room" / arm.key)
        assert (metadata.representation, metadata.held_out) == (arm.representation, [0, 8])
        assert float(row["psnr_db"]) > 5 and row["lpips"] == ""
        assert f"{float(row['psnr_db']):.2f}" in printed
    assert np.shape(cv2.imread(str(out / "room.png")))[1] > 5 * 64

    def fail(*args, **kwargs):
        raise ValueError("made again")

    monkeypatch.setattr(ablation, "reconstruct", fail)
    assert main(ablate) == 0
    titles = "".join(f"room: {arm.title}\n" for arm in ARMS)
    assert titles in printed
    assert capsys.readouterr().out == printed.replace(titles, "")
    (out / "room" / "2dgs_points" / "reconstruct.yaml").unlink()
    assert main(ablate) == 1
    assert "made again" in capsys.readouterr().err


def test_each_arm_adds_one_step():
    config = ReconstructConfig(iterations=123)
    for representation in ("3dgs", "2dgs"):
        arms = [arm_config(arm, config) for arm in ARMS if arm.representation == representation]
        differences = [
            {name for name, value in asdict(a).items() if asdict(b)[name] != value}
            for a, b in pairwise(arms)
        ]
        assert differences == [
            {"initialization", "strategy"},
            {"surface_weight", "outline_weight"},
            {"depth_weight"},
        ]
        assert (arms[0].initialization, arms[0].depth_weight) == ("points", 0.0)
        last = {"initialization": "depth", "distance_field": "captured"}
        assert arms[-1] == replace(config, representation=representation, **last)


def make_metrics(psnr: float, mae: float, floaters: float) -> SceneMetrics:
    depth = {"depth_mae_m": mae, "depth_relative": mae / 2}
    fractions = {"floater_fraction": floaters, "hole_fraction": floaters / 10}
    colors = {"psnr_db": psnr, "psnr_on_black_db": psnr - 1, "ssim": 0.9, "lpips": None}
    view = ViewMetrics(**colors, **depth, **fractions, unseen_fraction=0.0, gain=1.0)
    return SceneMetrics(True, 8, 8, {0: view}, 8, 8, {0: view}, "none", None)


def test_means_and_spreads():
    one = {arm.key: make_metrics(30, 1.0, 0.1) for arm in ARMS}
    one["3dgs_depth_term"] = make_metrics(29.75, 0.1, 0.005)
    two = {arm.key: make_metrics(34, 3.0, 0.3) for arm in ARMS}
    result = AblationResult({"one": one, "two": two})
    rows = {(row[0], row[1]): row[2:] for row in result.table()}
    photometric = "3DGS from points, photometric"
    assert rows["mean ± spread", photometric][0::2][:2] == ["32.00 ± 2.83", "-"]
    found = rows["one", "3DGS + depth term"]
    assert found == ["29.75", "0.9000", "-", "0.100", "0.50%", "0.05%", "28.75"]
    assert rows["paper", photometric] == [
        *("29.35", "0.8706", "0.215", "0.974", "11.50%", "-", "-"),
    ]
    effects = result.verdicts()
    assert "photometric: depth error divided by 1.0, floaters by 1.0, PSNR +0.00" in effects[0]
    assert "one, 3DGS + depth term: depth error divided by 10.0, floaters by 20.0" in effects[2]
