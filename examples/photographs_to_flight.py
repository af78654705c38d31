"""From photographs to a flight in the place that they show.

    python examples/photographs_to_flight.py PHOTOS --between a.jpg b.jpg --distance 2.5

The same by commands:

    splatpilot reconstruct PHOTOS --out out/place/scene \\
        --set capture.scale.between=[a.jpg,b.jpg] --set capture.scale.distance=2.5
    splatpilot fly --scene out/place/scene --out out/place/flight

PHOTOS is a folder of overlapping photographs, or any other capture: those with metric depth
(RGB-D cameras, TartanAir) have a scale of their own and take no length. `a.jpg` is where that was
taken, `a.jpg@812,344` what is seen at its pixel. Photographs need
pycolmap (`pip install 'splatpilot[train,photos]'`), which finds out where each was taken.
"""

import argparse
from pathlib import Path

import splatpilot as sp
from splatpilot.diagrams.flight.fly import run as fly_and_film
from splatpilot.diagrams.worlds.scene_folder import SceneConfig
from splatpilot.training.captures.capture_config import ScaleConfig
from splatpilot.training.reconstruction.config import ReconstructConfig


def main(photos: Path, between: list[str], distance: float, iterations: int, out: Path) -> None:
    # Photographs alone do not tell a room from its doll's house. A length in it does.
    config = ReconstructConfig(iterations=iterations, voxel_size=0.1)
    config.capture.scale = ScaleConfig(between=between, distance=distance)
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
    parser.add_argument("--between", nargs=2, default=[], help="two photographs, or pixels of them")
    parser.add_argument("--distance", type=float, default=0.0, help="between these [m]")
    parser.add_argument("--iterations", type=int, default=-1, help="steps; -1 for enough")
    parser.add_argument("--out", type=Path, default=Path("out/place"))
    main(**vars(parser.parse_args()))
