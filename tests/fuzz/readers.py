"""What reads files of others, each with files to damage and a use of what it accepts."""

import dataclasses
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.math import RigidTransform

from fuzz import samples


@dataclasses.dataclass(frozen=True)
class Reader:
    """How one kind of file is written, read and used."""

    write: Callable[[Path], None]
    """Writes whole files into a folder."""
    damaged: str
    """Which of them are damaged, one at a time: patterns of names, parted by spaces."""
    read: Callable[[Path], Any]
    use: Callable[[Any], None]
    """Does with what was read what it is for; raises AssertionError where that is nonsense."""
    names: Callable[[str, Path], bool] = lambda message, folder: str(folder) in message
    """Whether a message says what it is about: of the file in a folder."""


def _finite(*arrays: Any) -> None:
    for array in arrays:
        assert np.isfinite(np.asarray(array, dtype=float)).all(), "values are not finite"


def _see(scene: Any) -> None:
    from splatpilot.systems.splats.baked_scene import BakedScene

    K = np.array([[10.0, 0, 8], [0, 10, 6], [0, 0, 1]])
    view = BakedScene(scene).render(K, 16, 12, RigidTransform([1.5, 1.5, -3.0]))
    _finite(view.color, view.alpha)
    assert not np.isnan(view.depth).any() and view.color.min() >= 0, "the picture is none"


def _query(esdf: Any) -> None:
    p_WQ = (esdf.lower_W + esdf.upper_W) / 2
    sample = esdf.query(p_WQ[None])
    _finite(sample.distance, sample.gradient, esdf.lower_W, esdf.upper_W)
    assert (esdf.upper_W > esdf.lower_W).all(), "the box is empty"


def _use_world(world: Any) -> None:
    _see(world.gaussians)
    _query(world.esdf)
    _finite(world.p_WS, world.p_WG)


def _use_capture(capture: Any) -> None:
    _finite(capture.K, *(X_WC.GetAsMatrix4() for X_WC in capture.X_WCs))
    assert capture.K[0, 0] > 0 and capture.K[1, 1] > 0, "a focal length is not positive"
    assert len(capture) >= 2 and capture.width > 0 and capture.height > 0, "there is no image"
    for i in range(len(capture)):
        try:
            frame = capture.frame(i)
        except (ValueError, OSError) as error:
            assert capture.folder in str(error), f"the message names no file: {error}"
            continue
        assert frame.image.shape == (capture.height, capture.width, 3), "sizes differ"
        assert frame.depth.shape == (capture.height, capture.width), "sizes differ"
        assert (frame.depth >= 0).all(), "a depth is negative or none"
    if capture.points is not None:
        _finite(capture.points.p_WQ, capture.points.colors)


def _write_ply(text: bool) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        from plyfile import PlyData

        from splatpilot.systems.splats.gaussian_ply import write_ply

        write_ply(samples.gaussians(), folder / "scene.ply")
        if text:
            ply = PlyData.read(str(folder / "scene.ply"), mmap=False)
            PlyData(ply.elements, text=True).write(str(folder / "scene.ply"))

    return write


def _read_ply(folder: Path) -> Any:
    from splatpilot.systems.splats.gaussian_ply import read_ply

    return read_ply(folder / "scene.ply")


def _esdf() -> Any:
    from splatpilot.systems.collision.esdf import Esdf

    rng = np.random.default_rng(0)
    states = rng.integers(0, 3, (5, 4, 3), dtype=np.uint8)
    return Esdf(rng.normal(size=(5, 4, 3)).astype(np.float32), states, np.zeros(3), 0.5)


def _read_esdf(folder: Path) -> Any:
    from splatpilot.systems.collision.esdf import Esdf

    return Esdf.load(folder / "esdf.npz")


def _write_scene(folder: Path) -> None:
    from splatpilot.diagrams.worlds.scene_folder import write_scene_folder
    from splatpilot.diagrams.worlds.world import World
    from splatpilot.systems.splats.background import EnvironmentMap

    esdf, ends = _esdf(), (np.array([0.5, 0.5, 0.5]), np.array([1.5, 1.0, 0.5]))
    sky = EnvironmentMap(np.full((4, 8, 3), 0.5, np.float32))
    world = World("a", samples.gaussians(), esdf, esdf, sky, *ends)
    write_scene_folder(folder / "scene", world, samples.gaussians(3), provenance="by hand")


def _read_scene(folder: Path) -> Any:
    from splatpilot.diagrams.worlds.scene_folder import read_scene

    return read_scene(folder / "scene")


def _read_octomap(folder: Path) -> Any:
    from splatpilot.systems.collision.octomap import esdf_from_octomap

    return esdf_from_octomap(folder / "map.bt", np.array([-2.0, -2, -2]), np.array([3.0, 3, 3]))


def _write_mesh(folder: Path) -> None:
    import trimesh
    from trimesh.exchange.gltf import export_gltf

    scene = trimesh.Scene(trimesh.creation.box((2.0, 2.0, 2.0)))
    [content] = export_gltf(scene, embed_buffers=True).values()
    (folder / "mesh.gltf").write_bytes(content)


def _read_mesh(folder: Path) -> Any:
    from splatpilot.training.captures.mesh_renderer import check_mesh
    from splatpilot.training.captures.render_capture import mesh_distance

    check_mesh(folder / "mesh.gltf", "y")
    return folder / "mesh.gltf", mesh_distance(folder / "mesh.gltf", "y", 0.25)


def _use_mesh(mesh: Any) -> None:
    from splatpilot.systems.opengl import require_opengl
    from splatpilot.training.captures.mesh_renderer import MeshRenderer

    file, esdf = mesh
    _query(esdf)
    try:
        require_opengl()
    except OSError:
        return
    K = np.array([[10.0, 0, 8], [0, 10, 6], [0, 0, 1]])
    try:
        renderer = MeshRenderer(file, "y", (0.0, 0.0, 0.0))
    except ValueError as error:
        assert str(file) in str(error), f"the message names no file: {error}"
        return
    frame = renderer.frame(RigidTransform([0.0, 0, -3]), K, 16, 12)
    assert not np.isnan(frame.depth).any(), "the picture is none"


def _scenario(folder: Path) -> Any:
    from splatpilot.diagrams.scenario import Scenario
    from splatpilot.systems.configuration import load_config

    scenario = load_config(Scenario(), folder / "scenario.yaml")
    scenario.validate()
    return scenario


def _write_scenario(folder: Path) -> None:
    from splatpilot.diagrams.scenario import Scenario
    from splatpilot.systems.configuration import dump_config

    (folder / "scenario.yaml").write_text(dump_config(Scenario()))


def _names_field(message: str, folder: Path) -> bool:
    """Fields of configurations say which they are: overrides may have set them, and no file."""
    value = r" (?:is|are|=|times|would|of|leaves|must|has no place) "
    return str(folder) in message or re.match(rf"^[\w.' ]*?[\w.]+{value}", message) is not None


def _use_config(config: Any) -> None:
    from splatpilot.systems.configuration import dump_config, parse_config

    again = parse_config(type(config)(), dump_config(config), "its own text")
    assert dump_config(again) == dump_config(config), "it is not what it writes"
    again.validate()


def _write_training(folder: Path) -> None:
    from splatpilot.systems.configuration import dump_config
    from splatpilot.training.reconstruction.config import ReconstructConfig

    (folder / "config.yaml").write_text(dump_config(ReconstructConfig()))


def _training(folder: Path) -> Any:
    from splatpilot.systems.configuration import load_config
    from splatpilot.training.reconstruction.config import ReconstructConfig

    config = load_config(ReconstructConfig(), folder / "config.yaml")
    config.validate()
    return config


def _write_weights(folder: Path) -> None:
    from splatpilot.systems.policies.diffaero_inference import DIFFAERO_NETWORK
    from splatpilot.systems.policies.policy_checkpoint import PolicyCheckpoint

    rng = np.random.default_rng(0)
    weights = {
        name: rng.normal(scale=0.1, size=shape).astype(np.float32)
        for name, shape in DIFFAERO_NETWORK.weight_shapes().items()
    }
    checkpoint = PolicyCheckpoint("diffaero", DIFFAERO_NETWORK, weights, {"seed": 3})
    checkpoint.save(folder / "diffaero.npz")


def _read_weights(folder: Path) -> Any:
    from splatpilot.systems.policies.diffaero_inference import DIFFAERO_NETWORK
    from splatpilot.systems.policies.recurrent_network import load_network

    return load_network(str(folder / "diffaero.npz"), "diffaero", DIFFAERO_NETWORK)


def _use_weights(network: Any) -> None:
    spec = network.spec
    image = np.ones((spec.image_height, spec.image_width), np.float32)
    state, hidden = np.ones(spec.state_size, np.float32), np.zeros(spec.hidden_size, np.float32)
    for _ in range(3):
        output, hidden = network.step(image, state, hidden)
        _finite(output, hidden)


def _read_study(folder: Path) -> Any:
    from splatpilot.analysis.benchmark.study_folder import StudyFolder
    from splatpilot.analysis.benchmark.study_inputs import kept_flights

    study = StudyFolder(folder / "study")
    specs = study.config().rollouts()
    assert study.program() and study.shard() is None
    flights = [study.read(spec) for spec in specs]
    return study, flights, list(kept_flights(study, specs))


def _use_study(read: Any) -> None:
    from splatpilot.analysis.benchmark.tables import policy_table

    study, flights, kept = read
    policy_table([row for row, _ in flights], study.config(), 0)
    for (spec, scenario), (row, arrays) in zip(kept, flights, strict=True):
        assert row["id"] == spec.id
        study.read_timing(spec.id)
        scenario.validate()
        if arrays:
            _finite(arrays["times"], arrays["states"])


def _read_capture(folder: Path) -> Any:
    from splatpilot.training.captures.read_capture import read_capture

    return read_capture(folder)


READERS = {
    "PLY, binary": Reader(_write_ply(False), "*", _read_ply, _see),
    "PLY, ASCII": Reader(_write_ply(True), "*", _read_ply, _see),
    "scene folder": Reader(_write_scene, "scene/*", _read_scene, _use_world),
    "distance field": Reader(
        lambda folder: _esdf().save(folder / "esdf.npz"), "*", _read_esdf, _query
    ),
    "OctoMap": Reader(samples.write_octomap, "*", _read_octomap, _query),
    "glTF": Reader(_write_mesh, "*", _read_mesh, _use_mesh),
    "scenario": Reader(_write_scenario, "*", _scenario, _use_config, _names_field),
    "configuration": Reader(_write_training, "*", _training, _use_config, _names_field),
    "weights": Reader(_write_weights, "*", _read_weights, _use_weights),
    "study": Reader(
        samples.write_study,
        "study/study.yaml study/rollouts/* study/scenarios/* study/timings/*",
        _read_study,
        _use_study,
    ),
    "TartanAir": Reader(samples.write_tartanair, "* */*", _read_capture, _use_capture),
    "TUM": Reader(samples.write_tum, "* */*", _read_capture, _use_capture),
    "7-Scenes": Reader(samples.write_seven_scenes, "*", _read_capture, _use_capture),
    "nerfstudio": Reader(
        samples.write_nerfstudio, "*.json *.json *.json *", _read_capture, _use_capture
    ),
    "COLMAP, binary": Reader(
        samples.write_colmap, "sparse/0/* images/*", _read_capture, _use_capture
    ),
    "COLMAP, text": Reader(
        lambda folder: samples.write_colmap(folder, text=True),
        "sparse/0/*",
        _read_capture,
        _use_capture,
    ),
}
"""By name."""

os.environ.setdefault("SPLATPILOT_READ_LIMIT", "0.5")
