"""Draws samples of a corpus: color and depth, with the trajectories over both."""

from pathlib import Path

import cv2
import numpy as np
from matplotlib import colormaps

from splatpilot.systems.common.files import written_atomically
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.training.corpus.corpus import Corpus
from splatpilot.training.corpus.samples import EXPERT, SOURCES

_SCALE = 3  # pixels per pixel of an image
_COLUMNS = 4
_NEAR = 0.3  # [m], minimum depth of projected points
_COLORS = ((60, 255, 60), (255, 200, 0), (255, 80, 80))  # RGB of trajectories, cheapest first
_GOAL = (255, 0, 255)


def draw_sheet(corpus: Corpus, out: Path, count: int, seed: int = 0) -> None:
    """Draws `count` random samples into the PNG `out`. Trajectories are green, yellow and red in
    order of cost; a goal ahead is a magenta ring."""
    rng = np.random.default_rng(seed)
    indices = np.sort(rng.choice(len(corpus), min(count, len(corpus)), replace=False))
    samples = corpus.samples(indices)
    camera = corpus.config.camera
    tiles = []
    for i, index in enumerate(indices):
        depth = samples.depth[i].astype(np.float32)
        near = np.where(np.isfinite(depth), np.log1p(depth) / np.log1p(camera.max_depth), 1.0)
        shaded = (255 * colormaps["magma"](1.0 - near)[..., :3]).astype(np.uint8)
        panels = [
            _draw_labels(image, camera, samples.trajectories_B[i], samples.goal_B[i])
            for image in (samples.color[i], shaded)
        ]
        world = corpus.worlds[samples.world[i]].name
        source = "" if samples.source[i] == EXPERT else f", {SOURCES[samples.source[i]]}"
        text = f"{index}: {world}{source}, {np.linalg.norm(samples.v_B[i]):.1f} m/s"
        panels[0][:22] //= 3  # contrast for the text
        cv2.putText(panels[0], text, (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 255), 1)
        tiles.append(np.concatenate(panels))
    columns = min(_COLUMNS, len(tiles))
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % columns)
    rows = [np.concatenate(tiles[k : k + columns], axis=1) for k in range(0, len(tiles), columns)]
    out.parent.mkdir(parents=True, exist_ok=True)
    with written_atomically(out) as path:
        path.write_bytes(cv2.imencode(".png", np.concatenate(rows)[..., ::-1])[1].tobytes())


def _draw_labels(
    image: np.ndarray, camera: OnboardCamera, trajectories_B: np.ndarray, goal_B: np.ndarray
) -> np.ndarray:
    """Enlarges an image (H, W, 3), and draws trajectories (K, 10, 3) [m] and a goal (3,) [m]."""
    image = cv2.resize(image, None, fx=_SCALE, fy=_SCALE, interpolation=cv2.INTER_NEAREST)
    for waypoints_B, color in reversed(list(zip(trajectories_B, _COLORS, strict=False))):
        points = _SCALE * project(camera, waypoints_B[np.isfinite(waypoints_B).all(axis=1)])
        line = np.round(16 * points).astype(np.int32)  # sixteenths of a pixel: shift=4
        cv2.polylines(image, [line[:, None]], False, color, 2, cv2.LINE_AA, shift=4)
        for x, y in np.round(points).astype(int).tolist():
            cv2.circle(image, (x, y), 4, color, -1, cv2.LINE_AA)
    for x, y in np.round(_SCALE * project(camera, 1e3 * goal_B[None])).astype(int).tolist():
        cv2.circle(image, (x, y), 9, _GOAL, 2, cv2.LINE_AA)
    return image


def project(camera: OnboardCamera, p_BQ: np.ndarray) -> np.ndarray:
    """Projects points p_BQ (N, 3) [m] in front of the camera to columns and rows (n, 2) [px]."""
    p_CQ = camera.X_BC().inverse().multiply(p_BQ.T.astype(float)).reshape(3, -1).T
    p_CQ = p_CQ[p_CQ[:, 2] > _NEAR]
    center = np.array([camera.width, camera.height]) / 2
    focal = np.array([camera.focal_x, camera.focal_y])
    return center + focal * p_CQ[:, :2] / p_CQ[:, 2:]
