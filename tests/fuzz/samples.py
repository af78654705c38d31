"""Small valid files of every kind that is read."""

import gzip
import json
import struct
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import trimesh
import zstandard
from plyfile import PlyData, PlyElement
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.diagrams.worlds.scene_folder import write_scene_folder
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.splats.background import EnvironmentMap
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.splats.splat_files import write_ply

WIDTH, HEIGHT, FRAMES, COUNT = 16, 12, 6, 20
R_WC = RotationMatrix(np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]]))
POSES = [RigidTransform(R_WC, [0.2 * i, 0.05 * i**2, 1.0]) for i in range(FRAMES)]
DEPTH = np.full((HEIGHT, WIDTH), 2.0, np.float32)


def gaussians() -> GaussianScene:
    rng = np.random.default_rng(0)
    return GaussianScene(
        means=rng.uniform(0, 3, (COUNT, 3)).astype(np.float32),
        quats=rng.normal(size=(COUNT, 4)).astype(np.float32),
        scales=rng.uniform(0.05, 0.2, (COUNT, 3)).astype(np.float32),
        opacities=rng.uniform(0.1, 0.9, COUNT).astype(np.float32),
        sh=rng.normal(size=(COUNT, 4, 3)).astype(np.float32),
    )


def esdf() -> Esdf:
    rng = np.random.default_rng(0)
    states = rng.integers(0, 3, (5, 4, 3), dtype=np.uint8)
    return Esdf(rng.normal(size=(5, 4, 3)).astype(np.float32), states, np.zeros(3), 0.5)


def write_ascii_ply(folder: Path) -> None:
    write_ply(gaussians(), folder / "scene.ply")
    ply = PlyData.read(str(folder / "scene.ply"), mmap=False)
    PlyData(ply.elements, text=True).write(str(folder / "scene.ply"))


def write_compressed_ply(folder: Path) -> None:
    rng = np.random.default_rng(0)
    ends = [f"{end}_{part}{a}" for end in ("min", "max") for part in ("", "scale_") for a in "xyz"]
    chunk = np.array([(0.0, 0, 0, -3, -3, -3, 3, 3, 3, -2, -2, -2)], [(n, "f4") for n in ends])
    names = [f"packed_{what}" for what in ("position", "rotation", "scale", "color")]
    packed = rng.integers(0, 2**32, (COUNT, 4), dtype=np.uint32)
    vertex = packed.view([(name, "u4") for name in names])[:, 0]
    elements = [PlyElement.describe(chunk, "chunk"), PlyElement.describe(vertex, "vertex")]
    PlyData(elements).write(str(folder / "scene.ply"))


def write_spz(folder: Path, version: int) -> None:
    rng = np.random.default_rng(0)
    widths = 9, 1, 3, 3, 4, 9  # [bytes] of a Gaussian in the sections of degree 1
    sections = [rng.integers(0, 256, COUNT * width, dtype=np.uint8) for width in widths]
    sections[0].reshape(-1, 3)[:, 2] = 0  # positions of 0 to 16 m
    sections = [section.tobytes() for section in sections]
    if version == 3:
        header = struct.pack("<4sII4B", b"NGSP", 3, COUNT, 1, 12, 0, 0)
        (folder / "scene.spz").write_bytes(gzip.compress(header + b"".join(sections), 0))
        return
    streams = [zstandard.ZstdCompressor().compress(section) for section in sections]
    header = struct.pack("<4sII4BI12x", b"NGSP", 4, COUNT, 1, 12, 0, len(streams), 32)
    sizes = zip(streams, sections, strict=True)
    table = b"".join(struct.pack("<QQ", len(stream), len(section)) for stream, section in sizes)
    (folder / "scene.spz").write_bytes(header + table + b"".join(streams))


def write_splat(folder: Path) -> None:
    rng = np.random.default_rng(0)
    records = np.zeros(COUNT, [("p", "<f4", 3), ("s", "<f4", 3), ("bytes", "u1", 8)])
    records["p"], records["s"] = rng.uniform(0, 3, (2, COUNT, 3))
    records["bytes"] = rng.integers(0, 256, (COUNT, 8))
    records.tofile(folder / "scene.splat")


def write_scene(folder: Path) -> None:
    sky = EnvironmentMap(np.full((4, 8, 3), 0.5, np.float32))
    ends = np.array([0.5, 0.5, 0.5]), np.array([1.5, 1.0, 0.5])
    world = World("a", gaussians(), esdf(), esdf(), sky, *ends)
    write_scene_folder(folder / "scene", world, gaussians(), provenance="by hand")


def write_octomap(folder: Path) -> None:
    """A tree with an occupied voxel, free ones beside it and a free cube."""
    masks = [3 << 14] + [3] * 13 + [3 | 1 << 2] + [2 | 1 << 2 | 1 << 4 | 1 << 6]
    head = f"# Octomap OcTree binary file\nid OcTree\nsize {len(masks) + 5}\nres 0.5\ndata\n"
    (folder / "map.bt").write_bytes(head.encode() + np.array(masks, "<u2").tobytes())


def write_mesh(folder: Path) -> None:
    trimesh.Scene(trimesh.creation.box((2.0, 2.0, 2.0))).export(folder / "mesh.glb")


def write_image(file: Path, i: int) -> None:
    pixels = np.random.default_rng(i).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    cv2.imwrite(str(file), pixels)


def quaternion_row(X: RigidTransform) -> str:
    w, x, y, z = X.rotation().ToQuaternion().wxyz()
    return " ".join(f"{value:.9f}" for value in (*X.translation(), x, y, z, w))


def write_tartanair(folder: Path) -> None:
    (folder / "image_left").mkdir()
    (folder / "depth_left").mkdir()
    for i in range(FRAMES):
        write_image(folder / f"image_left/{i:06d}_left.png", i)
        np.save(folder / f"depth_left/{i:06d}_left_depth.npy", DEPTH)
    (folder / "pose_left.txt").write_text("\n".join(map(quaternion_row, POSES)) + "\n")


def write_tum(folder: Path) -> None:
    (folder / "rgb").mkdir()
    (folder / "depth").mkdir()
    lines: dict[str, list[str]] = {"rgb": [], "depth": [], "groundtruth": []}
    for i, X_WC in enumerate(POSES):
        write_image(folder / f"rgb/{i}.png", i)
        cv2.imwrite(str(folder / f"depth/{i}.png"), (5000 * DEPTH).astype(np.uint16))
        lines["rgb"].append(f"{100 + i / 30:.4f} rgb/{i}.png")
        lines["depth"].append(f"{100 + i / 30:.4f} depth/{i}.png")
        lines["groundtruth"].append(f"{100 + i / 30:.4f} {quaternion_row(X_WC)}")
    for name, rows in lines.items():
        (folder / f"{name}.txt").write_text("# a list\n" + "\n".join(rows) + "\n")


def write_seven_scenes(folder: Path) -> None:
    for i, X_WC in enumerate(POSES):
        write_image(folder / f"frame-{i:06d}.color.png", i)
        depth = (1000 * DEPTH).astype(np.uint16)
        cv2.imwrite(str(folder / f"frame-{i:06d}.depth.png"), depth)
        np.savetxt(folder / f"frame-{i:06d}.pose.txt", X_WC.GetAsMatrix4())


def write_nerfstudio(folder: Path) -> None:
    frames = []
    for i, X_WC in enumerate(POSES):
        write_image(folder / f"{i}.png", i)
        np.save(folder / f"{i}.npy", 1000 * DEPTH)
        matrix = (X_WC.GetAsMatrix4() @ np.diag([1, -1, -1, 1])).tolist()
        frame = {"file_path": f"{i}.png", "transform_matrix": matrix}
        frames.append(frame | {"depth_file_path": f"{i}.npy"})
    content = {"w": WIDTH, "h": HEIGHT, "fl_x": 10.0, "cx": 8.0, "cy": 6.0, "k1": 0.01}
    (folder / "transforms.json").write_text(json.dumps(content | {"frames": frames}))


def write_colmap(folder: Path, text: bool) -> None:
    (folder / "images").mkdir()
    model, params = pycolmap.Reconstruction(), [10.0, 10.0, 8.0, 6.0]
    camera = pycolmap.Camera(
        model="PINHOLE", width=WIDTH, height=HEIGHT, params=params, camera_id=1
    )
    model.add_camera_with_trivial_rig(camera)
    for i, X_WC in enumerate(POSES):
        write_image(folder / f"images/{i}.png", i)
        points = [pycolmap.Point2D([5.0, 5.0]), pycolmap.Point2D([9.0, 3.0])]
        seen = pycolmap.Image(name=f"{i}.png", points2D=points, camera_id=1, image_id=i + 1)
        model.add_image_with_trivial_frame(seen, pycolmap.Rigid3d(X_WC.inverse().GetAsMatrix34()))
    for k in range(2):
        track = pycolmap.Track([pycolmap.TrackElement(1, k), pycolmap.TrackElement(2, k)])
        model.add_point3D([2.0, 0.1 * k, 1.0], track, [10, 20, 30])
    (folder / "sparse/0").mkdir(parents=True)
    (model.write_text if text else model.write)(folder / "sparse/0")
