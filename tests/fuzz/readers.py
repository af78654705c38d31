"""What reads files of others, each with files to damage and a use of what it accepts."""

import dataclasses
import os
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


def require_finite(*arrays: Any) -> None:
    for array in arrays:
        assert np.isfinite(np.asarray(array, dtype=float)).all(), "values are not finite"


def see(scene: Any) -> None:
    from splatpilot.systems.splats.baked_scene import BakedScene

    K = np.array([[10.0, 0, 8], [0, 10, 6], [0, 0, 1]])
    view = BakedScene(scene).render(K, 16, 12, RigidTransform([1.5, 1.5, -3.0]))
    require_finite(view.color, view.alpha)
    assert not np.isnan(view.depth).any() and view.color.min() >= 0, "the picture is none"


def _query(esdf: Any) -> None:
    p_WQ = (esdf.lower_W + esdf.upper_W) / 2
    sample = esdf.query(p_WQ[None])
    require_finite(sample.distance, sample.gradient, esdf.lower_W, esdf.upper_W)
    assert (esdf.upper_W > esdf.lower_W).all(), "the box is empty"


def _use_world(world: Any) -> None:
    see(world.gaussians)
    _query(world.esdf)
    require_finite(world.p_WS, world.p_WG)


def _use_capture(capture: Any) -> None:
    require_finite(capture.K, *(X_WC.GetAsMatrix4() for X_WC in capture.X_WCs))
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
        require_finite(capture.points.p_WQ, capture.points.colors)


def _write_ply(text: bool) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        from plyfile import PlyData

        from splatpilot.systems.splats.splat_files import write_ply

        write_ply(samples.gaussians(), folder / "scene.ply")
        if text:
            ply = PlyData.read(str(folder / "scene.ply"), mmap=False)
            PlyData(ply.elements, text=True).write(str(folder / "scene.ply"))

    return write


def _read_ply(folder: Path) -> Any:
    from splatpilot.systems.splats.splat_files import read_ply

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
    from splatpilot.training.captures.render import check_mesh, mesh_distance

    check_mesh(folder / "mesh.gltf", "y")
    return folder / "mesh.gltf", mesh_distance(folder / "mesh.gltf", "y", 0.25)


def _use_mesh(mesh: Any) -> None:
    from splatpilot.systems.common.extras import require_opengl
    from splatpilot.training.captures.render import MeshRenderer

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


def _read_capture(folder: Path) -> Any:
    from splatpilot.training.captures.capture_registry import read_capture

    return read_capture(folder)


def _read_photographs(folder: Path) -> Any:
    from splatpilot.training.captures.capture_config import CaptureConfig
    from splatpilot.training.captures.colmap import read_photographs

    config = CaptureConfig(cache=str(folder / "cache"))
    return folder, read_photographs(folder, config)


def _use_photographs(read: Any) -> None:
    from splatpilot.training.captures.colmap import one_camera, photographs_in

    folder, capture = read
    one_camera([file for file in photographs_in(folder) if file.name in capture.frame_names])
    _use_capture(capture)


READERS = {
    "PLY, binary": Reader(_write_ply(False), "*", _read_ply, see),
    "PLY, ASCII": Reader(_write_ply(True), "*", _read_ply, see),
    "scene folder": Reader(_write_scene, "scene/*", _read_scene, _use_world),
    "distance field": Reader(
        lambda folder: _esdf().save(folder / "esdf.npz"), "*", _read_esdf, _query
    ),
    "OctoMap": Reader(samples.write_octomap, "*", _read_octomap, _query),
    "glTF": Reader(_write_mesh, "*", _read_mesh, _use_mesh),
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
    "photographs": Reader(
        samples.write_photographs,
        "images/* cache/model/*",
        _read_photographs,
        _use_photographs,
    ),
}
"""By name."""

os.environ.setdefault("SPLATPILOT_READ_LIMIT", "0.5")
