import csv

import numpy as np
import pytest
import trimesh
from scipy.stats import spearmanr

from splatpilot.analysis import twin
from splatpilot.analysis.commands.main import main
from splatpilot.analysis.twin import TwinConfig, cohen_kappa, predictions, rank_correlations
from splatpilot.systems.common.config import dump_config
from splatpilot.training.captures.render import RECIPE, RenderConfig, RenderedWorld
from tests.analysis.conftest import SIZE


def make_pairs(mesh, splat) -> list[dict]:
    """Rows of successes (environments, policies, routes)."""
    return [
        {"environment": f"e{e}", "policy": f"p{p}", "route": r, "mesh": int(m), "splat": int(s)}
        for ((e, p, r), m), s in zip(np.ndenumerate(mesh), np.ravel(splat), strict=True)
    ]


def test_intervals_cover_the_truth_and_shrink_with_routes(monkeypatch):
    monkeypatch.setattr(twin, "_RESAMPLES", 1000)
    rng, rates, widths = np.random.default_rng(1), np.linspace(0.05, 0.95, 12)[:, None], []
    for routes in (5, 80):
        mesh, splat = (rng.uniform(size=(2, 12, routes)) < rates for _ in range(2))
        every = predictions(make_pairs(mesh, splat))[-1]
        assert every["rho_low"] < every["rho"] <= every["rho_high"] <= 1
        widths.append(every["rho_high"] - every["rho_low"])
    assert widths[1] < 0.5 * widths[0]
    every = predictions(make_pairs(mesh, mesh))[-1]
    assert every["environment"] == "all" and every["flights"] == 2 * 12 * 80
    assert every["agreement"] == every["kappa"] == every["rho"] == every["rho_low"] == 1
    useless = predictions(make_pairs(mesh, rng.uniform(size=mesh.shape) < 0.5))[-1]
    assert abs(useless["kappa"]) < 0.1 and useless["rho_low"] < 0 < useless["rho_high"]


def test_control_is_correlated_with_the_mesh():
    mesh = np.zeros((1, 3, 4), bool)
    mesh[0, 1, :2] = mesh[0, 2] = True
    control = [{"policy": f"p{p}", "speed": 2.0, "success": p == 0} for p in range(3)]
    (_, every) = predictions(make_pairs(mesh, mesh), control)
    assert every["rho"] == 1
    assert every["control"] == pytest.approx(spearmanr([0, 0.5, 1], [1, 0, 0]).statistic, abs=1e-4)


def test_rank_correlations_and_kappa():
    x, y = np.random.default_rng(0).integers(0, 6, (2, 5, 12)).astype(float)
    expected = [spearmanr(a, b).statistic for a, b in zip(x, y, strict=True)]
    np.testing.assert_allclose(rank_correlations(x, y), expected)
    assert np.isnan(rank_correlations(np.ones((1, 4)), np.arange(4.0)[None]))
    # Cohen's example: 20 and 15 agree of 50, chance agrees in half of them.
    first = np.repeat([1, 1, 0, 0], [20, 5, 10, 15])
    second = np.repeat([1, 0, 1, 0], [20, 5, 10, 15])
    assert cohen_kappa(first, second) == pytest.approx(0.4)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"policies": []}, "policies must be one policy or more"),
        ({"routes": 101}, r"seeds of split dev must be in \[1, 100\], got 101"),
        ({"control": ["P99"]}, "there is no scenario 'P99'"),
    ],
)
def test_invalid_fields_are_errors_before_anything_is_flown(fields, message, tmp_path):
    config = TwinConfig(**{"policies": ["straight"]} | fields)
    with pytest.raises(ValueError, match=message):
        twin.run(scenes=[tmp_path / "scene"], out=tmp_path / "out", config=config)


def test_policies_fly_the_same_routes_in_scene_and_mesh(opengl, room, tmp_path, capsys):
    box = trimesh.creation.box(SIZE)
    box.apply_translation(SIZE / 2)
    box.invert()
    box.export(tmp_path / "room.obj", include_normals=True)
    capture = tmp_path / "capture"
    capture.mkdir()
    recipe = RenderedWorld(str(tmp_path / "room.obj"), config=RenderConfig(up="z"))
    (capture / RECIPE).write_text(dump_config(recipe))
    scene, out = room.scene("perfect", capture=str(capture)), tmp_path / "out"
    settings = ("routes=2", "policies=[straight, diffaero@3]", "control=[]")
    settings += ("repeat_radius=0.05",)
    command = ["scene", "twin", str(scene), "--out", str(out), "--jobs", "1"]
    main([*command, *(word for setting in settings for word in ("--set", setting))])
    assert "perfect: 4 flights, success 100.0% in the mesh" in capsys.readouterr().out
    rows = list(csv.DictReader((out / "flights.csv").open()))
    assert [(row["policy"], row["route"]) for row in rows] == [
        (policy, str(route)) for policy in ("straight", "diffaero@3") for route in range(2)
    ]
    for row in rows:
        assert row["splat"] == row["mesh"] == row["again"] == "1"
        mesh, again = (float(row[f"{kind}_clearance_m"]) for kind in ("mesh", "again"))
        assert 0 < abs(mesh - again) < 0.05
    assert (out / "twin.png").is_file() and (out / "twin.csv").is_file()


def test_policies_are_grouped_by_speed():
    groups = twin.policies_by_speed(["planner", "fast=diffaero@4", "a=reactive:margin=0.1"])
    assert groups == {2.0: ["planner", "a=reactive:margin=0.1"], 4.0: ["fast=diffaero"]}


@pytest.mark.parametrize(
    ("policies", "message"),
    [
        (["diffaero@fast"], r"the speed of diffaero@fast must be a number \[m/s\], got fast"),
        (["diffaero@50"], r"the speed must be in"),
        (["unregistered"], "unregistered"),
        (["straight"], r"must be of a rendered capture, got .*capture render"),
    ],
)
def test_invalid_policies_and_scenes_without_a_mesh_are_refused(room, tmp_path, policies, message):
    scene, config = room.scene("perfect", capture=str(tmp_path)), twin.TwinConfig(policies=policies)
    with pytest.raises(ValueError, match=message):
        twin.run(scenes=[scene], out=tmp_path / "out", config=config)
