"""From a mesh to a flight: render a capture, reconstruct it, fly in what came of it."""

from dataclasses import dataclass, field
from pathlib import Path

from splatpilot.analysis.reconstruction import run as reconstruction
from splatpilot.analysis.reconstruction.measure_scene import METRICS, measure_scene
from splatpilot.diagrams.flight import fly
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.worlds.scene_folder import read_scene_metadata
from splatpilot.diagrams.worlds.world_registry import SceneConfig
from splatpilot.systems.common.files import claim_folder, holds_folder
from splatpilot.training.captures import render as render_capture
from splatpilot.training.captures.render import RenderConfig
from splatpilot.training.reconstruction.config import ReconstructConfig


@dataclass
class TourConfig:
    """How each stage of a tour is done."""

    render: RenderConfig = field(default_factory=lambda: RenderConfig(spacing=0.8, apart=4.0))
    # Places through which one flies are larger than those that one looks at: voxels of which the
    # planner can search a whole hall in seconds.
    reconstruct: ReconstructConfig = field(
        default_factory=lambda: ReconstructConfig(voxel_size=0.1)
    )
    flight: Scenario = field(default_factory=Scenario)  # its world is the reconstruction


@holds_folder("out")
def run(
    *, world: str | Path, out: Path, scene: Path | None, config: TourConfig, seed: int = 0
) -> dict[str, float | str]:
    """Renders `world` to `out/capture`, reconstructs that as `scene` (`out/scene` if None), flies
    in it, leaving `out/flight`, and returns the summary of the flight.

    What is there from a run of the same configuration is used again: an interrupted tour goes on.

    Raises:
        FileNotFoundError, ValueError, OSError: see `render_capture.run`, `make_scene` and
            `fly.run`; or if `out` holds a tour of another configuration, or something else.
    """
    capture = out / "capture"
    scene = out / "scene" if scene is None else scene
    config.flight.world = SceneConfig(path=str(scene.absolute()))
    claim_folder(out / "tour.yaml", config)
    render_capture.run(world=world, out=capture, config=config.render, seed=seed)
    make_scene(capture, scene, config.reconstruct)
    return fly.run(scenario=config.flight, out=out / "flight", overwrite=True)


def make_scene(capture: Path, scene: Path, config: ReconstructConfig) -> None:
    """Reconstructs and measures a capture, or leaves a scene that was made of it as it is.

    Raises:
        FileNotFoundError, ValueError, OSError: see `reconstruction.run`; or if `scene` was made of
            another capture.
    """
    if not (scene / "scene.yaml").is_file():
        reconstruction.run(capture=capture, out=scene, config=config)
        return
    made_of = read_scene_metadata(scene).capture
    if Path(made_of) != capture.absolute():
        raise ValueError(
            f"{scene}: was made of {made_of or 'another capture'}, not of {capture}; name another "
            "folder with --scene"
        )
    if (scene / METRICS).is_file():
        print(f"{scene}: is reconstructed already")
    else:
        print(measure_scene(scene))
