"""Small whole files of every kind, to be damaged."""

import json
from pathlib import Path

import cv2
import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.systems.splats.scene import GaussianScene

WIDTH, HEIGHT, FRAMES = 16, 12, 6
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def gaussians(count: int = 20) -> GaussianScene:
    rng = np.random.default_rng(0)
    return GaussianScene(
        means=rng.uniform(0, 3, (count, 3)).astype(np.float32),
        quats=rng.normal(size=(count, 4)).astype(np.float32),
        scales=rng.uniform(0.05, 0.2, (count, 3)).astype(np.float32),
        opacities=rng.uniform(0.1, 0.9, count).astype(np.float32),
        sh=rng.normal(size=(count, 4, 3)).astype(np.float32),
    )


def poses() -> list[RigidTransform]:
    """Of a level camera (x right, y down, z forward) that looks along x."""
    R_WC = RotationMatrix(np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]]))
    return [RigidTransform(R_WC, [0.2 * i, 0.05 * i**2, 1.0]) for i in range(FRAMES)]


def image(i: int) -> np.ndarray:
    return np.random.default_rng(i).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def depth() -> np.ndarray:
    return np.full((HEIGHT, WIDTH), 2.0, np.float32)


def quaternion_row(X: RigidTransform) -> str:
    w, x, y, z = X.rotation().ToQuaternion().wxyz()
    return " ".join(f"{value:.9f}" for value in (*X.translation(), x, y, z, w))


def write_tartanair(folder: Path) -> None:
    (folder / "image_left").mkdir()
    (folder / "depth_left").mkdir()
    for i in range(FRAMES):
        cv2.imwrite(str(folder / f"image_left/{i:06d}_left.png"), image(i))
        np.save(folder / f"depth_left/{i:06d}_left_depth.npy", depth())
    rows = [quaternion_row(X) for X in poses()]
    (folder / "pose_left.txt").write_text("\n".join(rows) + "\n")


def write_tum(folder: Path) -> None:
    (folder / "rgb").mkdir()
    (folder / "depth").mkdir()
    lists: dict[str, list[str]] = {"rgb": [], "depth": [], "groundtruth": []}
    for i, X_WC in enumerate(poses()):
        time = 100.0 + i / 30
        cv2.imwrite(str(folder / f"rgb/{i}.png"), image(i))
        cv2.imwrite(str(folder / f"depth/{i}.png"), (5000 * depth()).astype(np.uint16))
        lists["rgb"].append(f"{time:.4f} rgb/{i}.png")
        lists["depth"].append(f"{time:.4f} depth/{i}.png")
        lists["groundtruth"] += [
            f"{time + offset:.4f} {quaternion_row(X_WC)}" for offset in (-0.005, 0.005)
        ]
    for name, lines in lists.items():
        (folder / f"{name}.txt").write_text("# a list\n" + "\n".join(lines) + "\n")


def write_seven_scenes(folder: Path) -> None:
    for i, X_WC in enumerate(poses()):
        stem = str(folder / f"frame-{i:06d}")
        cv2.imwrite(f"{stem}.color.png", image(i))
        cv2.imwrite(f"{stem}.depth.png", (1000 * depth()).astype(np.uint16))
        np.savetxt(f"{stem}.pose.txt", X_WC.GetAsMatrix4())


def write_nerfstudio(folder: Path) -> None:
    frames = []
    for i, X_WC in enumerate(poses()):
        cv2.imwrite(str(folder / f"{i}.png"), image(i))
        np.save(folder / f"{i}.npy", 1000 * depth())
        matrix = (X_WC.GetAsMatrix4() @ OPENGL).tolist()
        frames.append(
            {"file_path": f"{i}.png", "transform_matrix": matrix, "depth_file_path": f"{i}.npy"}
        )
    content = {"w": WIDTH, "h": HEIGHT, "fl_x": 10.0, "fl_y": 10.0, "cx": 8.0, "cy": 6.0}
    content |= {"k1": 0.01, "depth_unit_scale_factor": 0.001, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content))


def write_colmap(folder: Path, *, text: bool = False) -> None:
    import pycolmap

    (folder / "images").mkdir()
    model = pycolmap.Reconstruction()
    parameters = [10.0, 10.0, 8.0, 6.0]
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(model="PINHOLE", width=WIDTH, height=HEIGHT, params=parameters, camera_id=1)
    )
    for i, X_WC in enumerate(poses()):
        name = f"{i}.png"
        cv2.imwrite(str(folder / "images" / name), image(i))
        points = [pycolmap.Point2D([5.0, 5.0]), pycolmap.Point2D([9.0, 3.0])]
        seen = pycolmap.Image(name=name, points2D=points, camera_id=1, image_id=i + 1)
        X_CW = pycolmap.Rigid3d(X_WC.inverse().GetAsMatrix34())
        model.add_image_with_trivial_frame(seen, X_CW)
    for k in range(2):
        track = pycolmap.Track([pycolmap.TrackElement(1, k), pycolmap.TrackElement(2, k)])
        model.add_point3D([2.0, 0.1 * k, 1.0], track, [10, 20, 30])
    (folder / "sparse" / "0").mkdir(parents=True)
    if text:
        model.write_text(folder / "sparse" / "0")
    else:
        model.write(folder / "sparse" / "0")


def write_photographs(folder: Path) -> None:
    """Photographs that say what took them, and the registration that is kept of them."""
    from PIL import Image

    write_colmap(folder)
    (folder / "cache").mkdir()
    (folder / "sparse" / "0").rename(folder / "cache" / "model")
    (folder / "sparse").rmdir()
    exif = Image.Exif()
    exif[0x0110] = "a camera"
    exif.get_ifd(0x8769)[0x920A] = 4.5
    for file in (folder / "images").iterdir():
        with Image.open(file) as photograph:
            photograph.save(file, exif=exif)


def write_octomap(folder: Path) -> None:
    """A tree with an occupied voxel, free ones beside it and a free cube, by hand."""
    masks = [3 << 14] + [3] * 13 + [3 | 1 << 2] + [2 | 1 << 2 | 1 << 4 | 1 << 6]
    head = f"# Octomap OcTree binary file\nid OcTree\nsize {len(masks) + 5}\nres 0.5\ndata\n"
    (folder / "map.bt").write_bytes(head.encode() + np.array(masks, "<u2").tobytes())


def write_study(folder: Path) -> None:
    """A study of two flights, as `splatpilot benchmark` would have left it."""
    from splatpilot.analysis.benchmark.study import StudyConfig
    from splatpilot.analysis.benchmark.study_folder import StudyFolder
    from splatpilot.diagrams.flight.scenario import Scenario
    from splatpilot.systems.common.config import dump_config

    config = StudyConfig(["P02"], ["straight", "reactive"], [2.0], seeds=1)
    study = StudyFolder(folder / "study")
    study.claim(config, {"splatpilot": "0", "numpy": "2"})
    (study.path / "scenarios" / "P02.yaml").write_text(dump_config(Scenario()))
    measures = {name: 1.5 for name in ("flight_time_s", "path_length_m", "mean_speed_m_s")}
    measures |= {"min_clearance_m": 0.5, "jerk_m_s3": 2.0, "shortest_path_m": 1.0}
    measures |= {"success": True, "outcome": "goal", "digest": "00" * 8, "path_excess": 0.1}
    measures |= {"smoothness": -3.0}
    states = np.zeros((9, 13), np.float32)
    states[:, 6] = 1.0
    for spec in config.rollouts():
        np.savez_compressed(
            study.trajectory(spec.id),
            row=np.array(json.dumps(spec._asdict() | measures)),
            times=np.arange(9, dtype=np.float32),
            states=states,
            commands=np.zeros((9, 4), np.float32),
            clearances=np.ones(9, np.float32),
        )
        (study.path / "timings" / f"{spec.id}.json").write_text('{"id": "x", "total_s": 1.5}')
