"""From photographs to a flight in the place that they show.

    python examples/photographs_to_flight.py PHOTOS --camera-height 1.6 --out out/place

The same by commands:

    splatpilot view PHOTOS --set scale.camera_height=1.6
    splatpilot reconstruct PHOTOS --set capture.scale.camera_height=1.6 --out out/place/scene
    splatpilot fly --scene out/place/scene --out out/place/flight

PHOTOS is a folder of overlapping photographs, or any other capture: those with metric depth
(RGB-D cameras, TartanAir) have a scale of their own and take no `--camera-height`. Photographs need
pycolmap (`pip install 'splatpilot[train,photos]'`), which finds out where each was taken.
"""

import argparse
from pathlib import Path

import splatpilot as sp
from splatpilot.diagrams.fly import run as fly_and_film
from splatpilot.diagrams.worlds.scene import SceneConfig
from splatpilot.training.reconstruction.config import ReconstructConfig


def main(photos: Path, camera_height: float | None, iterations: int, out: Path) -> None:
    # Photographs alone do not tell a room from its doll's house. That the cameras were held at a
    # height above the floor does; so do two cameras and their distance, see CaptureConfig.
    config = ReconstructConfig(iterations=iterations, voxel_size=0.1)
    if camera_height is not None:
        config.capture.scale.camera_height = camera_height
    capture = sp.read_capture(photos, config.capture)
    print(capture)

    # Interrupted, this goes on where it was: the same call ends in the same scene.
    print(sp.reconstruct(capture, out / "scene", config))

    # Start and goal are chosen from the free space that was seen, as far apart as one can fly.
    scenario = sp.Scenario(world=SceneConfig(path=str((out / "scene").absolute())))
    fly_and_film(scenario=scenario, out=out / "flight")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("photos", type=Path)
    parser.add_argument("--camera-height", type=float, help="above the floor [m]")
    parser.add_argument("--iterations", type=int, default=-1, help="steps; -1 for enough")
    parser.add_argument("--out", type=Path, default=Path("out/place"))
    main(**vars(parser.parse_args()))
