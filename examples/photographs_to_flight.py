"""From photographs to a flight in the scene.

    python examples/photographs_to_flight.py PHOTOS --between a.jpg b.jpg --distance 2.5

The same by commands:

    splatpilot reconstruct PHOTOS --out out/photos/scene \\
        --set capture.scale.between=[a.jpg,b.jpg] --set capture.scale.distance=2.5
    splatpilot fly --scene out/photos/scene --out out/photos/flight

PHOTOS is a folder of overlapping photographs, or another capture; metric depth (RGB-D cameras,
TartanAir) needs no length. `a.jpg` is the position of its camera, `a.jpg@812,344` the surface at
its pixel. Photographs need pycolmap for their poses (`pip install 'splatpilot[train,photos]'`).
"""

import argparse
from pathlib import Path

import splatpilot as sp
from splatpilot.diagrams.flight.fly import run as fly_and_film
from splatpilot.diagrams.worlds.scene_folder import SceneConfig
from splatpilot.training.captures.capture_config import ScaleConfig
from splatpilot.training.reconstruction.config import ReconstructConfig


def main(photos: Path, between: list[str], distance: float, iterations: int, out: Path) -> None:
    # Photographs have no scale; a known length gives it.
    config = ReconstructConfig(iterations=iterations, voxel_size=0.1)
    config.capture.scale = ScaleConfig(between=between, distance=distance)
    capture = sp.read_capture(photos, config.capture)
    print(capture)

    # If interrupted, the same call resumes and gives the same scene.
    print(sp.reconstruct(capture, out / "scene", config))

    # Start and goal are far apart in the observed free space.
    scenario = sp.Scenario(world=SceneConfig(path=str((out / "scene").absolute())))
    fly_and_film(scenario=scenario, out=out / "flight")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("photos", type=Path)
    parser.add_argument("--between", nargs=2, default=[], help="two photographs, or pixels of them")
    parser.add_argument("--distance", type=float, default=0.0, help="between these [m]")
    parser.add_argument("--iterations", type=int, default=-1, help="steps; -1 for enough")
    parser.add_argument("--out", type=Path, default=Path("out/photos"))
    main(**vars(parser.parse_args()))
