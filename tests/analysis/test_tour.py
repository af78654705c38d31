"""From a mesh to a flight."""

import json

import numpy as np
import trimesh
from pydrake.math import RigidTransform

from splatpilot.analysis.commands.main import main
from splatpilot.training.captures.render import true_camera

SMALL = [
    "render.width=64",
    "render.height=48",
    "render.path=[[-2, 0, 0], [2, 0, 0]]",
    "render.spacing=1",
    "render.yaws=[0, 90, 180, -90]",
    "reconstruct.iterations=20",
    "reconstruct.image_width=0",
    "reconstruct.initial_gaussians=2000",
    "reconstruct.distance_field=captured",
    "reconstruct.voxel_size=0.1",
    "flight.camera.width=64",
    "flight.camera.height=48",
    "flight.timeout=10",
]


def test_a_room_is_captured_reconstructed_and_flown_in(opengl, tmp_path, capsys):
    """One command leaves a capture, a measured scene and a flight that reached its goal; run again
    it uses what is there; it refuses other settings there, and a scene of something else."""
    room = tmp_path / "room.obj"
    mesh = trimesh.creation.box((7.0, 4.0, 3.0))
    mesh.invert()
    mesh.export(room, include_normals=True)
    out = tmp_path / "tour"
    command = ["tour", str(room), "--up", "z", "--out", str(out)]
    for option in SMALL:
        command += ["--set", option]
    assert main(command) == 0
    summary = json.loads((out / "flight" / "summary.json").read_text())
    assert summary["outcome"] == "goal"
    assert summary["path_length_m"] > 1
    assert (out / "scene" / "metrics.json").is_file()
    camera = true_camera(out / "capture")
    assert camera is not None
    np.testing.assert_array_equal(camera(RigidTransform()).depth.shape, (48, 64))

    capsys.readouterr()
    assert main(command) == 0
    printed = capsys.readouterr().out
    assert "is rendered already" in printed
    assert "is reconstructed already" in printed

    (out / "scene" / "metrics.json").unlink()  # as a kill while it is measured leaves it
    assert main(command) == 0
    assert (out / "scene" / "metrics.json").is_file() and (out / "scene" / "views.png").is_file()
    capsys.readouterr()
    assert main([*command, "--set", "reconstruct.iterations=25"]) == 1
    assert "tour.yaml holds another configuration" in capsys.readouterr().err
    other = [str(tmp_path / "other") if word == str(out) else word for word in command]
    assert main([*other, "--scene", str(out / "scene")]) == 1
    assert "was made of" in capsys.readouterr().err
