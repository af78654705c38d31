"""The gradient of a distance field moves points away from obstacles.

    python examples/distance_gradient.py

A distance field gives the distance to the nearest surface, its gradient, and the state (free,
occupied, unknown) of many points at once. The gradient is the exact derivative of `distance`, so
trajectories can be optimized through it, also in torch: `Esdf.distance` takes tensors. Fields come
from worlds and scenes, depth images, OctoMaps and shapes.
"""

import argparse

import numpy as np

import splatpilot as sp
from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS


def main(points: int, steps: int) -> None:
    scenario = sp.load_config(sp.Scenario(), overrides=["world.length=16"])
    world = sp.make_world(scenario.world, seed=0)
    esdf = world.esdf
    print(f"{esdf.shape} voxels of {esdf.voxel_size} m, {esdf.volume(FieldState.FREE):.0f} m3 free")

    # Points in the flyable volume where the vehicle does not fit.
    rng = np.random.default_rng(0)
    p_WQ = rng.uniform(esdf.lower_W + 1, esdf.upper_W - 1, (points, 3))
    start = esdf.distance(p_WQ)
    tight = (start > 0) & (start < VEHICLE_RADIUS)
    p_WQ, start = p_WQ[tight], start[tight]

    sample = esdf.query(p_WQ)
    step = 1e-4 * rng.normal(size=p_WQ.shape)
    error = esdf.distance(p_WQ + step) - start - np.sum(sample.gradient * step, axis=1)
    print(f"{len(p_WQ)} points too close; gradients predict to {np.median(abs(error)):.0e} m")

    # Moves each point away from its nearest surface until the vehicle fits.
    for _ in range(steps):
        sample = esdf.query(p_WQ)
        fits = (sample.distance > 2 * VEHICLE_RADIUS)[:, None]
        p_WQ = np.where(fits, p_WQ, p_WQ + 0.05 * sample.gradient)
    ended = esdf.distance(p_WQ)
    print(
        f"{np.mean(ended > VEHICLE_RADIUS):.0%} have clearance after at most {0.05 * steps:.2f} m"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--points", type=int, default=20_000, help="that are tried")
    parser.add_argument("--steps", type=int, default=20, help="of 5 cm along the gradient")
    main(**vars(parser.parse_args()))
