import csv
from dataclasses import asdict, replace
from itertools import pairwise

import cv2
import numpy as np
import pytest

from splatpilot.analysis.commands.main import main
from splatpilot.analysis.reconstruction import ablation
from splatpilot.analysis.reconstruction.ablation import ARMS, AblationResult, arm_config
from splatpilot.analysis.reconstruction.measure_scene import SceneMetrics
from splatpilot.diagrams.worlds.scene_folder import read_scene_metadata
from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.metrics import ViewMetrics

SETTINGS = ("iterations=12", "threads=1", "initial_gaussians=2000", "voxel_size=0.2")


def ablate(place, *words: str, captures: tuple[str, ...] = ("room",)) -> int:
    settings = [word for setting in SETTINGS for word in ("--set", setting)]
    return main(
        ["scene", "ablate", *captures, "--out", str(place.folder / "out"), *settings, *words]
    )


def test_ablation_end_to_end(place, capsys, monkeypatch):
    assert ablate(place) == 0
    printed = capsys.readouterr().out
    assert "paper    3DGS + depth term" in printed
    table = (place.folder / "out" / "ablation.md").read_text()
    paper = "| paper | 2DGS from points, photometric | 29.07 | 0.8656 | 0.228 | 1.466 | 13.00% |"
    assert paper in table
    with open(place.folder / "out" / "ablation.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["arm"] for row in rows[:8]] == [arm.key for arm in ARMS]
    assert {row["arm"] for row in rows[8:]} == {
        *("3dgs_points", "3dgs_depth_term", "2dgs_points", "2dgs_depth_term")
    }
    for arm, row in zip(ARMS, rows, strict=False):
        metadata = read_scene_metadata(place.folder / "out" / "room" / arm.key)
        assert metadata.representation == arm.representation
        assert metadata.held_out == [0, 8]
        assert float(row["psnr_db"]) > 5 and row["lpips"] == ""
        assert f"{float(row['psnr_db']):.2f}" in printed
    assert np.shape(cv2.imread(str(place.folder / "out" / "room.png")))[1] > 5 * 64

    def fail(*args, **kwargs):
        raise ValueError("made again")

    monkeypatch.setattr(ablation, "reconstruct", fail)
    assert ablate(place) == 0
    titles = "".join(f"room: {arm.title}\n" for arm in ARMS)
    assert titles in printed
    assert capsys.readouterr().out == printed.replace(titles, "")
    # An arm that is missing would be made.
    (place.folder / "out" / "room" / "2dgs_points" / "reconstruct.yaml").unlink()
    assert ablate(place) == 1
    assert "made again" in capsys.readouterr().err


def test_studies_are_not_mixed(place, monkeypatch, capsys):

    def make(capture, scene, config):
        place.scene(f"out/room/{scene.name}")
        made.append(scene.name)

    made: list[str] = []
    monkeypatch.setattr(ablation, "reconstruct", make)
    assert ablate(place) == 0
    table = (place.folder / "out" / "ablation.csv").read_bytes()
    capsys.readouterr()
    other = str(place.scene("scene", capture="room"))
    other_steps = "--set", "iterations=13"
    for words, captures in ((other_steps, ("room",)), ((), (other,))):
        assert ablate(place, *words, captures=captures) == 1
        assert "ablation.yaml holds another configuration" in capsys.readouterr().err
    assert len(made) == len(ARMS)
    assert (place.folder / "out" / "ablation.csv").read_bytes() == table
    assert ablate(place, *other_steps, "--overwrite") == 0
    assert len(made) == 2 * len(ARMS)


def test_each_arm_adds_what_its_name_says():
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
        assert asdict(arms[-1]) == asdict(
            replace(
                config,
                representation=representation,
                initialization="depth",
                distance_field="captured",
            )
        )


def measures(psnr: float, mae: float, share: float) -> SceneMetrics:
    view = ViewMetrics(
        psnr_db=psnr,
        psnr_on_black_db=psnr - 1,
        ssim=0.9,
        lpips=None,
        depth_mae_m=mae,
        depth_relative=mae / 2,
        floater_fraction=share,
        hole_fraction=share / 10,
        unseen_fraction=0.0,
        gain=1.0,
    )
    return SceneMetrics(True, 8, 8, {0: view}, {0: view}, "none", None)


def test_means_and_spreads():
    one = {arm.key: measures(30, 1.0, 0.1) for arm in ARMS}
    one["3dgs_depth_term"] = measures(29.75, 0.1, 0.005)
    two = {arm.key: measures(34, 3.0, 0.3) for arm in ARMS}
    result = AblationResult({"one": one, "two": two})
    rows = {(row[0], row[1]): row[2:] for row in result.table()}
    photometric = "3DGS from points, photometric"
    assert rows["mean ± spread", photometric][0] == "32.00 ± 2.83"
    assert rows["mean ± spread", photometric][2] == "-"
    assert rows["one", "3DGS + depth term"] == [
        *("29.75", "0.9000", "-", "0.100", "0.50%", "0.05%", "28.75")
    ]
    assert rows["paper", photometric] == [
        *("29.35", "0.8706", "0.215", "0.974", "11.50%"),
        "-",
        "-",
    ]
    assert result.verdicts()[:3] == [
        "one, 3DGS from depth, photometric: depth error divided by 1.0, floaters by 1.0, "
        "PSNR +0.00 dB",
        "one, 3DGS + surface and outline losses: depth error divided by 1.0, floaters by 1.0, "
        "PSNR +0.00 dB",
        "one, 3DGS + depth term: depth error divided by 10.0, floaters by 20.0, PSNR -0.25 dB",
    ]


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("hold_out=0", "hold_out must be not 0"),
        ("iterations=0", "iterations must be not 0"),
        ("hold_out=1", "hold_out must be 0 or"),
    ],
)
def test_bad_settings(place, capsys, setting, message):
    assert main(["scene", "ablate", "room", "--out", str(place.folder), "--set", setting]) == 1
    assert message in capsys.readouterr().err


def test_two_captures_of_one_name(place, capsys):
    for other in ("room", str(place.scene("scene"))):
        assert main(["scene", "ablate", "room", other, "--out", str(place.folder / "out")]) == 1
        assert "two captures are called room" in capsys.readouterr().err
