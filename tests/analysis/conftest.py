from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

import splatpilot as sp
from splatpilot.analysis.reconstruction import ablation
from splatpilot.diagrams.worlds.scene_folder import write_scene_folder
from splatpilot.systems.collision.esdf_build import esdf_from_occupancy
from splatpilot.training.captures import capture_registry
from splatpilot.training.captures.capture import Capture, SfmPoints

WIDTH, HEIGHT = 64, 48
K = np.array([[32.0, 0, 32], [0, 32.0, 24], [0, 0, 1]])
SIZE = np.array([6.0, 3.0, 2.5])  # [m], the room, its lower corner in the origin
R_WC = RotationMatrix(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]))  # looking along x, level


def make_room() -> sp.GaussianScene:
    """The inside of the room, in broad colored waves."""
    axes = (np.arange(0.05, size, 0.1) for size in SIZE)
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    walls = [(axis, at) for axis in range(3) for at in (0.0, SIZE[axis])]
    means = [np.unique(np.where(np.arange(3) == axis, at, grid), axis=0) for axis, at in walls]
    means = np.concatenate(means)
    x, y, z = means.T
    waves = np.column_stack([np.sin(3 * x) * np.cos(4 * z), np.cos(5 * y), np.sin(3 * z + 2 * x)])
    sizes, opacities = np.full_like(means, 0.06), np.full(len(means), 0.95)
    quats = np.tile([1.0, 0, 0, 0], (len(means), 1))
    return sp.GaussianScene.from_colors(means, quats, sizes, opacities, 0.5 + 0.3 * waves)


@dataclass(frozen=True)
class Room:
    """The room, its capture and a folder for scenes of it."""

    gaussians: sp.GaussianScene
    capture: Capture
    folder: Path

    def scene(self, name: str, gaussians: sp.GaussianScene | None = None, **metadata) -> Path:
        """Writes a scene folder with these Gaussians, the room's own if None."""
        free = esdf_from_occupancy(*np.zeros((2, 60, 30, 25), bool), np.zeros(3), 0.1)
        gaussians = self.gaussians if gaussians is None else gaussians
        world = sp.World(name, gaussians, free, free, (0.0, 0.0, 0.0), np.ones(3), np.ones(3))
        metadata = {"capture": "room", "held_out": [0, 8]} | metadata
        write_scene_folder(self.folder / name, world, provenance="a test", **metadata)
        return self.folder / name


@pytest.fixture(scope="session")
def set_fields() -> Callable[..., list[str]]:
    """Returns the words of a command line that set fields, FIELD=VALUE each."""
    return lambda *fields: [word for field in fields for word in ("--set", field)]


@pytest.fixture(scope="session")
def seen_room() -> tuple[sp.GaussianScene, Capture]:
    gaussians = make_room()
    baked = sp.BakedScene(gaussians)
    X_WCs = [RigidTransform(R_WC, [0.5 + 0.15 * i, 1.5, 1.2]) for i in range(16)]
    views = [baked.render(K, WIDTH, HEIGHT, X_WC) for X_WC in X_WCs]
    images = [np.round(255 * np.clip(view.color, 0, 1)).astype(np.uint8) for view in views]
    capture = Capture(
        name="room",
        source="a room of Gaussians",
        K=K,
        width=WIDTH,
        height=HEIGHT,
        X_WCs=X_WCs,
        load_image=lambda i: images[i],
        load_depth=lambda i: views[i].depth,
        points=SfmPoints(gaussians.means[::7].astype(float), gaussians.base_colors[::7]),
    )
    return gaussians, capture


@pytest.fixture
def room(seen_room, tmp_path, monkeypatch) -> Room:
    """The room; a capture at the path "room" is its capture."""
    gaussians, capture = seen_room

    def read_capture(path, config=None):
        assert str(path) == "room"
        return capture

    for module in (ablation, capture_registry):
        monkeypatch.setattr(module, "read_capture", read_capture)
    monkeypatch.delenv("SPLATPILOT_DATA", raising=False)
    (tmp_path / "captures" / "room").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "captures")
    return Room(gaussians, capture, tmp_path)
