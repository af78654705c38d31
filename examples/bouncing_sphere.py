"""A sphere bounces on the surfaces of a world, in Drake's MultibodyPlant.

    python examples/bouncing_sphere.py --scene scenes/hospital --out sphere.csv

SCENE is a scene folder or an OctoMap, by default a generated forest. `splatpilot scene mesh`
writes the same mesh as a file. Needs `pip install 'splatpilot[mesh]'`.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
from pydrake.geometry import (
    AddCompliantHydroelasticProperties,
    AddContactMaterial,
    AddRigidHydroelasticProperties,
    Mesh,
    ProximityProperties,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import LogVectorOutput

import splatpilot as sp
from splatpilot.diagrams.worlds.world_registry import scene_config

RADIUS = 0.15  # [m]


def main(scene: Path | None, seconds: float, out: Path) -> None:
    world = sp.make_world(sp.Scenario().world if scene is None else scene_config(scene), seed=0)
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, time_step=1e-3)
    rigid, elastic = ProximityProperties(), ProximityProperties()
    AddRigidHydroelasticProperties(rigid)
    AddCompliantHydroelasticProperties(0.5 * RADIUS, 2e5, elastic)
    friction = CoulombFriction(0.8, 0.6)
    AddContactMaterial(friction=friction, properties=rigid)
    AddContactMaterial(dissipation=0.1, friction=friction, properties=elastic)
    body = plant.AddRigidBody("sphere", SpatialInertia.SolidSphereWithMass(0.4, RADIUS))
    plant.RegisterCollisionGeometry(body, RigidTransform(), Sphere(RADIUS), "sphere", elastic)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "world.obj"
        # Conservative: unobserved space is no hole in the floor.
        sp.write_mesh(path, sp.field_mesh(world.esdf, conservative=True))
        mesh, X_WM = Mesh(path), RigidTransform()
        plant.RegisterCollisionGeometry(plant.world_body(), X_WM, mesh, "world", rigid)
        plant.Finalize()
        log = LogVectorOutput(plant.get_state_output_port(), builder, publish_period=0.02)
        simulator = Simulator(builder.Build())

    root = simulator.get_mutable_context()
    plant.SetFreeBodyPose(plant.GetMyMutableContextFromRoot(root), body, RigidTransform(world.p_WS))
    simulator.AdvanceTo(seconds)
    found = log.FindLog(root)
    p_WB = found.data()[4:7].T  # after the quaternion
    clearance = world.esdf.conservative().distance(p_WB) - RADIUS
    table = np.column_stack([found.sample_times(), p_WB, clearance])
    np.savetxt(out, table, "%.4f", ",", header="time,x,y,z,clearance", comments="")
    fall = p_WB[0, 2] - p_WB[:, 2].min()
    print(f"Wrote {out}: fell {fall:.2f} m, sank in by at most {-clearance.min():.3f} m.")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--scene", type=Path, help="scene folder or OctoMap")
    parser.add_argument("--seconds", type=float, default=3.0)
    parser.add_argument("--out", type=Path, default=Path("sphere.csv"))
    main(**vars(parser.parse_args()))
