"""From a capture, a mesh or a generated world to a measured scene folder."""

from dataclasses import dataclass, field, fields, replace
from pathlib import Path

from splatpilot.analysis.reconstruction.measure_scene import SHEET, measure_scene
from splatpilot.analysis.reconstruction.scene_measures import SceneMetrics
from splatpilot.diagrams.worlds.scene_folder import CAPTURE, check_scene_target, read_scene_metadata
from splatpilot.systems.common.files import held_folder, require_unused
from splatpilot.systems.common.progress import resumable
from splatpilot.systems.common.torch_device import require_renderer
from splatpilot.training.captures import render as render_capture
from splatpilot.training.captures.capture import Capture
from splatpilot.training.captures.capture_registry import read_capture
from splatpilot.training.captures.check import doubts
from splatpilot.training.captures.render import RenderConfig
from splatpilot.training.reconstruction.checkpoint import kept_work, work_folder
from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.reconstruct import ReconstructSummary, reconstruct


@dataclass
class RenderedSceneConfig(ReconstructConfig):
    """How a mesh or a generated world is captured and reconstructed."""

    render: RenderConfig = field(default_factory=lambda: RenderConfig(spacing=0.8, apart=4.0))
    voxel_size: float = 0.1  # [m] of the distance field; the planner searches a hall in seconds

    def reconstruct(self) -> ReconstructConfig:
        """Returns the part of the reconstruction."""
        return ReconstructConfig(
            **{each.name: getattr(self, each.name) for each in fields(ReconstructConfig)}
        )


def run_rendered(
    *,
    world: str | Path,
    out: str | Path,
    config: RenderedSceneConfig,
    seed: int = 0,
    restart: bool = False,
    overwrite: bool = False,
) -> tuple[ReconstructSummary, SceneMetrics]:
    """Renders a mesh or a scenario's generated world to `out/capture` and makes the scene `out` of
    it; see `render_capture.run` and `run`. A capture of the same settings is used again."""
    check_scene_target(out)
    capture = Path(out) / CAPTURE
    render_capture.run(world=world, out=capture, config=config.render, seed=seed)
    return run(
        capture=capture,
        out=out,
        config=config.reconstruct(),
        restart=restart,
        overwrite=overwrite,
    )


def run(
    *,
    capture: str | Path,
    out: str | Path,
    config: ReconstructConfig,
    restart: bool = False,
    overwrite: bool = False,
) -> tuple[ReconstructSummary, SceneMetrics]:
    """Turns the capture in a folder into the scene folder `out`, with its `metrics.json`, and
    prints what came of it; see `reconstruct` and `measure_scene`. With `overwrite` it takes the
    place of the scene that is there.

    Raises:
        FileNotFoundError, ValueError, OSError: for a damaged capture, a config that makes no sense,
            a checkpoint of another run, or a folder `out` that cannot be written or holds something
            else. No scene is written then.
    """
    # Said at once: photographs are registered for minutes before `reconstruct` could.
    config.validate()
    require_renderer(config.device)
    check_scene_target(out)
    if (Path(out) / SHEET).exists():
        require_unused(Path(out), overwrite)
    opened = read_capture(capture, config.capture)
    if (Path(out) / "scene.yaml").is_file() and not _is_unmeasured(Path(out), opened):
        require_unused(Path(out), overwrite)
    doubted = doubts(opened)
    for doubt in doubted:  # Said at once, for what follows takes long, and again in the end.
        print(f"warning: {doubt}", flush=True)
    with held_folder(work_folder(Path(out))):
        with resumable(lambda: kept_work(Path(out))):
            summary = reconstruct(opened, out, config, restart=restart)
        summary = replace(summary, warnings=(*doubted, *summary.warnings))
        print(summary)
        with resumable(lambda: f"{out} is made, but not measured; the same command measures it"):
            measures = measure_scene(Path(out), opened)
        print(measures)
    return summary, measures


def _is_unmeasured(scene: Path, capture: Capture) -> bool:
    """Whether an interrupted run has left this scene of the capture, and not measured it yet."""
    if (scene / SHEET).exists():
        return False
    metadata = read_scene_metadata(scene)
    made_of = metadata.capture, metadata.capture_settings
    return made_of == (capture.folder, capture.config.settings())
