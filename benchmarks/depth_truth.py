"""Compares the depth that policies get in generated worlds with rays cast at the solids.

    python benchmarks/depth_truth.py [--scenarios P01 P08] [--frames 24]

The cameras follow flights of the privileged planner. A pixel is wrong if it is off by more than
0.1 m or 5 %, the larger. Pixels of unknown truth are left out: scenery has no solids.
"""

import argparse
from collections.abc import Iterable
from typing import NamedTuple, cast

import numpy as np
import torch
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from pydrake.systems.sensors import ImageDepth32F

from splatpilot.diagrams.flight.flight_diagram import BuildFlightDiagram
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.flight.sensors import make_onboard_camera
from splatpilot.diagrams.flight.simulation import fly
from splatpilot.diagrams.scenarios import benchmark_scenarios, scenario_file
from splatpilot.diagrams.worlds.solids.solid import WorldSpec
from splatpilot.diagrams.worlds.solids.surfaces import merge
from splatpilot.diagrams.worlds.world_registry import make_spec, make_world
from splatpilot.systems.common.config import load_config
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.splats.baked_scene import BakedScene
from splatpilot.systems.vehicle.state import pose_from_state
from splatpilot.training.policies.ray_casting import PixelRays, ShapeGeometry
from splatpilot.training.reconstruction.losses import depth_edge_weights

CAMERAS = [OnboardCamera(64, 36), OnboardCamera(320, 240)]
_NEAR = 4.0  # [m], true depths below which relative errors are compared
_TOLERANCE, _RELATIVE_TOLERANCE = 0.1, 0.05  # [m], and as a fraction of the true depth
_BEYOND = 0.1  # [m], distance from the volume at which scenery begins
_MIN_ALPHA = 0.01  # of scenery that a pixel may show


class DepthFrame(NamedTuple):
    """Planar depth and truth (H, W) [m]; the truth is NaN if unknown."""

    depth: NDArray[np.floating]
    truth: NDArray[np.floating]


class DepthErrors(NamedTuple):
    """Errors of pixels."""

    pixels: int  # with known truth
    wrong: float  # fraction of pixels beyond the tolerance
    bias: float  # median relative error below 4 m


def depth_errors(frames: Iterable[DepthFrame], reach: float, edges: bool = True) -> DepthErrors:
    """Compares depth with the truth, both at most `reach` [m]; `edges` includes discontinuities."""
    pairs = []
    for depth, truth in frames:
        used = ~np.isnan(truth)
        if not edges:
            weights = depth_edge_weights(torch.from_numpy(truth), jump=0.05, far=reach)
            used &= (weights == 1).numpy()
        pairs.append((depth[used], truth[used]))
    depth, truth = (np.concatenate(column) for column in zip(*pairs, strict=True))
    truth = np.minimum(truth, reach)
    error = np.minimum(depth, reach) - truth
    tolerance = np.maximum(_TOLERANCE, _RELATIVE_TOLERANCE * truth)
    near = (truth < _NEAR) & np.isfinite(depth)
    bias = np.median(error[near] / truth[near])
    return DepthErrors(len(truth), float((np.abs(error) > tolerance).mean()), float(bias))


class TrueDepth:
    """Renders exact depth of a generated world's solids; scenery beyond the volume has none."""

    def __init__(self, spec: WorldSpec) -> None:
        self._lower_W, self._upper_W = spec.lower_W - _BEYOND, spec.upper_W + _BEYOND
        shapes = [solid.shape for solid in (*spec.solids, *spec.scenery)]
        self._geometry = ShapeGeometry([shapes])
        scenery = spec.surroundings()
        self._scenery = BakedScene(merge(scenery)) if scenery else None

    def image(self, camera: OnboardCamera, X_WC: RigidTransform) -> NDArray[np.floating]:
        """Returns planar depth (H, W) [m], exact to 3 mm; inf without a surface, NaN if unknown."""
        slopes_C = camera.ray_slopes()
        R_WC, p_WC = X_WC.rotation().matrix(), X_WC.translation()
        centers = PixelRays(slopes_C.reshape(-1, 3).astype(np.float32), half_pixel=0.0)
        p, R = (torch.tensor(x, dtype=torch.float32)[None] for x in (p_WC, R_WC))
        depth = self._geometry.depth(p, R, centers, torch.zeros(1).long()).numpy()
        depth = depth.reshape(slopes_C.shape[:2])
        with np.errstate(invalid="ignore"):
            p_WQ = p_WC + depth[..., None] * (slopes_C @ R_WC.T)
            outside = ~((p_WQ >= self._lower_W) & (p_WQ <= self._upper_W)).all(axis=-1)
            unknown = np.isfinite(depth) & (p_WQ[..., 2] > self._upper_W[2])
        if self._scenery is not None:
            K, size = camera.camera_info().intrinsic_matrix(), (camera.width, camera.height)
            view = self._scenery.render(K, *size, X_WC, near=0.01, far=camera.max_depth)
            unknown |= outside & (view.alpha > _MIN_ALPHA)
        return np.where(unknown, np.nan, depth)


def frames_along_flight(
    scenario: Scenario, cameras: list[OnboardCamera], count: int
) -> list[list[DepthFrame]]:
    """Flies a scenario, and returns `count` frames of each camera, evenly in time."""
    truth = TrueDepth(make_spec(scenario.world, scenario.seed))
    world = make_world(scenario.world, scenario.seed)
    flight = fly(BuildFlightDiagram(scenario, world, camera=False))
    rows = np.linspace(0, len(flight.states) - 1, count).astype(int)
    frames: list[list[DepthFrame]] = [[] for _ in cameras]
    for config, found in zip(cameras, frames, strict=True):
        camera = make_onboard_camera(config, world)
        context = camera.CreateDefaultContext()
        for X_WB in map(pose_from_state, flight.states[rows]):
            camera.GetInputPort("body_pose").FixValue(context, X_WB)
            image = cast(ImageDepth32F, camera.GetOutputPort("depth_image_32f").Eval(context))
            depth = np.array(image.data)[..., 0]
            found.append(DepthFrame(depth, truth.image(config, X_WB @ config.mount())))
    return frames


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    generated = [name for name in benchmark_scenarios() if name.startswith("P")]
    parser.add_argument("--scenarios", nargs="*", default=generated, help="generated, by name")
    parser.add_argument("--frames", type=int, default=24, help="along each flight")
    options = parser.parse_args()
    print("| scenario | size | wrong pixels | median relative error below 4 m |\n|---|---|---|---|")
    for name in options.scenarios:
        scenario = load_config(Scenario(), scenario_file(name))
        frames = frames_along_flight(scenario, CAMERAS, options.frames)
        for camera, seen in zip(CAMERAS, frames, strict=True):
            errors = depth_errors(seen, camera.max_depth)
            size, wrong, bias = f"{camera.width}x{camera.height}", errors.wrong, errors.bias
            print(f"| {name} | {size} | {100 * wrong:.2f} % | {100 * bias:.2f} % |", flush=True)


if __name__ == "__main__":
    main()
