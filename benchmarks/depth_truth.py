"""The depth that policies are handed against the truth: run by hand.

    python benchmarks/depth_truth.py [--scenarios P01 P08] [--seeds 0 1] [--frames 24]
    python benchmarks/depth_truth.py --scenes FOLDER...
    python benchmarks/depth_truth.py --ghosts [R13 R14]

Of generated worlds the truth are rays cast at their solids along the flight of the privileged
planner; of captured scenes, named by their folders, the depth of the frames that were withheld from
them. Errors are wrong beyond 0.1 m or 5 %, the larger. Pixels whose truth nobody knows are left
out: scenery beyond the volume has no solid. Relative errors are those of depths below 4 m. Ghosts
are pixels along the planner's flights through captured places whose depth ends where the distance
field is free, more than 0.3 m from all that it knows.
"""

import argparse
from pathlib import Path

from depth_errors import DepthFrame, depth_errors
from harness import header, row
from true_depth import (
    frames_along_flight,
    frames_of_capture,
    ghosts_along_flight,
)

from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.scenarios import benchmark_scenarios, scenario_file
from splatpilot.systems.common.config import load_config
from splatpilot.systems.sensing.onboard_camera import OnboardCamera

CAMERAS = [OnboardCamera(64, 36), OnboardCamera(320, 240)]
COLUMNS = (
    "pixels",
    "left out",
    "bias < 4 m",
    "p5",
    "p95",
    "too near",
    "too far",
    "> 0.5 m too near",
    "holes",
)


def show(name: str, frames: list[list[DepthFrame]]) -> None:
    """Prints the rows of a scenario or scene."""
    for camera, seen in zip(CAMERAS, frames, strict=True):
        for where, errors in depth_errors(seen, camera.max_depth).items():
            pixels, *shares = vars(errors).values()
            cells = [f"{100 * share:.2f} %" for share in shares]
            row(name, f"{camera.width}x{camera.height}", where, pixels, *cells)


def scenario_of(name: str, seed: int) -> Scenario:
    scenario = load_config(Scenario(), scenario_file(name))
    scenario.seed = seed
    return scenario


def main() -> None:
    parser = argparse.ArgumentParser(description="Compare the depth of cameras with the truth.")
    generated = [name for name in benchmark_scenarios() if name.startswith("P")]
    parser.add_argument("--scenarios", nargs="*", default=generated, help="generated, by name")
    parser.add_argument("--seeds", nargs="*", type=int, default=[0])
    parser.add_argument("--frames", type=int, default=24, help="along each flight")
    parser.add_argument("--scenes", nargs="*", type=Path, help="captured ones instead: folders")
    captured = [name for name in benchmark_scenarios() if name.startswith("R")]
    parser.add_argument("--ghosts", nargs="*", help="in captured places, by name; all if none is")
    arguments = parser.parse_args()
    if arguments.ghosts is not None:
        header("", "ghosts", "worst frame")
        for name in arguments.ghosts or captured:
            for seed in arguments.seeds:
                scenario = scenario_of(name, seed)
                shares = ghosts_along_flight(scenario, CAMERAS[0], arguments.frames)
                cells = (f"{100 * share:.2f} %" for share in (shares.mean(), shares.max()))
                row(f"{name}, seed {seed}", *cells)
        return
    header("", "size", "where", *COLUMNS)
    if arguments.scenes is not None:
        for folder in arguments.scenes:
            show(folder.name, frames_of_capture(folder, CAMERAS))
        return
    for name in arguments.scenarios:
        for seed in arguments.seeds:
            frames = frames_along_flight(scenario_of(name, seed), CAMERAS, arguments.frames)
            show(f"{name}, seed {seed}", frames)


if __name__ == "__main__":
    main()
