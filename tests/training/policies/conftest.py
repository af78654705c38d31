from pathlib import Path

import numpy as np
import pytest
import torch
from pydrake.math import RollPitchYaw

from splatpilot.systems.collision.esdf_build import esdf_from_distance_field
from splatpilot.systems.collision.shapes import AnalyticDistanceField, Cylinder, HalfSpace, Shape
from splatpilot.systems.common.files import claim_folder
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.training.corpus.collect import shard_folder
from splatpilot.training.corpus.corpus import CONFIG, EXPERT, CorpusConfig, Samples, write_shard
from splatpilot.training.corpus.expert import Labeler
from splatpilot.training.corpus.library import WorldSource, record_world
from splatpilot.training.policies.ray_casting import PixelRays, ShapeGeometry
from splatpilot.training.policies.vehicles import CAMERA_AHEAD

P_WG = np.array([11.0, 4.0, 1.5])
UPPER_W = np.array([12.0, 8.0, 3.0])
CAMERA = OnboardCamera(width=32, height=24)


@pytest.fixture(scope="session")
def student_corpus(tmp_path_factory) -> Path:
    """The folder of a corpus of 3 worlds with 24 samples each."""
    return _write_corpus(tmp_path_factory.mktemp("corpus"), 3, 24, CAMERA)


@pytest.fixture(scope="session")
def wide_corpus(tmp_path_factory) -> Path:
    """The folder of a corpus of 3 worlds with 16 samples each, of 160x120."""
    camera = OnboardCamera(width=160, height=120)
    return _write_corpus(tmp_path_factory.mktemp("wide_corpus"), 3, 16, camera)


def _write_corpus(folder: Path, worlds: int, states: int, camera: OnboardCamera) -> Path:
    """Random states on a path past pillars; near pixels are red, far ones blue."""
    config = CorpusConfig(camera=camera)
    claim_folder(folder / CONFIG, config)
    for part in ("worlds", "shards"):
        (folder / part).mkdir()
    rays = PixelRays.of(camera.width, camera.height, camera.fov_x)
    for number in range(worlds):
        rng = np.random.default_rng(number)
        shapes: list[Shape] = [HalfSpace(np.array([0.0, 0.0, 1.0]), 0.0)]
        for x, y in zip(rng.uniform(4, 9, 3), rng.permutation([2.0, 4.0, 6.0]), strict=True):
            shapes.append(Cylinder([x, y, -1], [x, y, 4], 0.4))
        exact = AnalyticDistanceField(shapes, np.zeros(3), UPPER_W)
        esdf = esdf_from_distance_field(exact, 0.25)
        source = WorldSource(f"pillars-{number}", seed=number)
        record_world(folder / "worlds" / source.name, source, esdf)
        labeler, geometry = Labeler(esdf, P_WG, config.expert), ShapeGeometry([shapes])
        samples, n = Samples.zeros(states, config.size), 0
        while n < states:
            p_WB = rng.uniform([1, 2, 1], [9, 6, 2])
            if labeler.field.distance(p_WB) < 0.7:
                continue
            yaw = np.arctan2(*(P_WG - p_WB)[1::-1]) + rng.normal(0, 0.4)
            rotation = RollPitchYaw(*rng.normal(0, 0.1, 2), yaw)
            R_WB, q_WB = rotation.ToRotationMatrix().matrix(), rotation.ToQuaternion().wxyz()
            v_B = rng.normal([1.5, 0, 0], 0.3)
            label = labeler.label(0.0, np.concatenate([p_WB, R_WB @ v_B, q_WB, np.zeros(3)]))
            x, y, z = R_WB.T
            p_WC = torch.tensor((p_WB + CAMERA_AHEAD * x)[None], dtype=torch.float32)
            R_WC = torch.tensor(np.stack([-y, -z, x], 1)[None], dtype=torch.float32)
            depth = geometry.depth(p_WC, R_WC, rays, torch.zeros(1, dtype=torch.int64))
            samples.depth[n] = depth.reshape(camera.height, camera.width).clamp(max=1e4)
            near = np.clip(1.0 - samples.depth[n].astype(float) / 10.0, 0.0, 1.0)
            samples.color[n] = 255.0 * np.stack([near, 0.0 * near, 1.0 - near], 2)
            samples.X_WB[n], samples.v_B[n] = (*q_WB, *p_WB), v_B
            samples.goal_B[n] = (P_WG - p_WB) @ R_WB
            samples.trajectories_B[n] = label.waypoints_B
            n += 1
        about = {"world": source.name, "source": EXPERT, "flights": [], "revision": ""}
        write_shard(shard_folder(folder, source.name), [samples], config.size, about)
    return folder
