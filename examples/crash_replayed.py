"""A crash, flown again bitwise identically, and a view of the obstacle.

    python examples/crash_replayed.py --out out/crash

Once a study is flown, `splatpilot replay out/crash P02-straight-2-000 --meshcat` does the same. It
writes a page that starts two seconds before the crash.
"""

import argparse
import csv
from pathlib import Path

import numpy as np
from PIL import Image

import splatpilot as sp
from splatpilot.analysis.benchmark import replay
from splatpilot.analysis.benchmark.run_study import run as fly_study
from splatpilot.analysis.benchmark.study import StudyConfig
from splatpilot.systems.vehicle.state import pose_from_state


def main(out: Path, scenario: str, before: float) -> None:
    study = StudyConfig(scenarios=[scenario], policies=["straight"], seeds=1)
    fly_study(config=study, out=out, jobs=1)
    with (out / "rollouts.csv").open() as file:
        crash = next(row for row in csv.DictReader(file) if row["outcome"] == "collision")

    # From the study's folder alone, and compared with the record.
    repeated = replay.run(study=out, id=crash["id"])
    assert repeated, "the same machine and libraries repeat the flight"

    # The view of a camera `before` seconds before the end, from the recorded states.
    config = sp.load_config(sp.Scenario(), out / "scenarios" / f"{crash['scenario']}.yaml")
    world = sp.make_world(config.world, int(crash["seed"]))
    with np.load(out / "rollouts" / f"{crash['id']}.npz") as flight:
        times, states = flight["times"], flight["states"]
    row = np.searchsorted(times, times[-1] - before)
    view = sp.MakeCamera(config, world).render(pose_from_state(states[row]))
    Image.fromarray((255 * view.color.clip(0, 1)).astype(np.uint8)).save(out / "before.png")

    # The gradient of the distance points away from the obstacle.
    gradient = world.distance_field.query(states[-1, :3]).gradient
    closing = -gradient @ states[-1, 3:6]
    print(
        f"{crash['id']} hit an obstacle along {np.round(-gradient, 2).tolist()} after "
        f"{times[-1]:.2f} s, at {closing:.2f} m/s. {before} s before, the nearest surface in its "
        f"view was {view.depth[view.depth > 0].min():.2f} m away: {out / 'before.png'}."
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("out/crash"))
    parser.add_argument("--scenario", default="P02", help="of the benchmark, or a file")
    parser.add_argument("--before", type=float, default=0.5, help="the crash [s]")
    main(**vars(parser.parse_args()))
