"""From a capture, a mesh or a generated world to a measured scene folder."""

from dataclasses import dataclass, field, fields, replace
from pathlib import Path

from splatpilot.analysis.reconstruction.measure_scene import VIEWS, SceneMetrics, measure_scene
from splatpilot.diagrams.worlds.scene_folder import CAPTURE, check_scene_target, read_scene_metadata
from splatpilot.systems.common.files import locked_folder, require_unused
from splatpilot.systems.common.progress import resumable
from splatpilot.systems.common.torch_device import require_renderer
from splatpilot.systems.common.validation import bounded
from splatpilot.training.captures import render as render_capture
from splatpilot.training.captures.capture_registry import read_capture
from splatpilot.training.captures.check import doubts
from splatpilot.training.captures.render import RenderConfig
from splatpilot.training.reconstruction.checkpoint import kept_work, work_folder
from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.reconstruct import ReconstructSummary, reconstruct


@dataclass
class RenderedSceneConfig(ReconstructConfig):
    """Settings of a mesh or a generated world: its capture and reconstruction."""

    render: RenderConfig = field(default_factory=lambda: RenderConfig())
    voxel_size: float = bounded(0.1, "[0, inf) m")
    """[m], of the distance field; the planner searches a hall in seconds."""

    def reconstruct(self) -> ReconstructConfig:
        """Returns the part of the reconstruction."""
        names = (each.name for each in fields(ReconstructConfig))
        return ReconstructConfig(**{name: getattr(self, name) for name in names})


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
    settings = config.reconstruct()
    return run(capture=capture, out=out, config=settings, restart=restart, overwrite=overwrite)


def run(
    *,
    capture: str | Path,
    out: str | Path,
    config: ReconstructConfig,
    restart: bool = False,
    overwrite: bool = False,
) -> tuple[ReconstructSummary, SceneMetrics]:
    """Reconstructs the capture in a folder as the scene folder `out`, measures it and prints the
    results; see `reconstruct` and `measure_scene`. With `overwrite` it replaces another scene."""
    out = Path(out)
    # Before photographs are registered, which takes minutes.
    config.validate()
    require_renderer(config.device)
    check_scene_target(out)
    if (out / VIEWS).exists():
        require_unused(out, overwrite)
    opened = read_capture(capture, config.capture)
    if (out / "scene.yaml").is_file() and not (out / VIEWS).exists():
        about = read_scene_metadata(out)
        made_from = about.capture, about.capture_settings
        if made_from != (opened.folder, opened.config.settings()):  # not to be measured only
            require_unused(out, overwrite)
    doubted = doubts(opened)
    for doubt in doubted:  # at once, and again in the summary
        print(f"warning: {doubt}", flush=True)
    with locked_folder(work_folder(out)):
        with resumable(lambda: kept_work(out)):
            summary = reconstruct(opened, out, config, restart=restart)
        summary = replace(summary, warnings=(*doubted, *summary.warnings))
        print(summary)
        with resumable(lambda: f"{out} is made, but not measured; the same command measures it"):
            metrics = measure_scene(out, opened)
        print(metrics)
    return summary, metrics
