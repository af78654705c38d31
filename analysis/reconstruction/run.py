"""From the folder of a capture to a scene folder that has been measured."""

from dataclasses import replace
from pathlib import Path

from splatpilot.analysis.reconstruction.measure_scene import SHEET, measure_scene
from splatpilot.analysis.reconstruction.scene_measures import SceneMetrics
from splatpilot.diagrams.worlds.scene_folder import check_scene_target, read_scene_metadata
from splatpilot.systems.common.files import held_folder, require_unused
from splatpilot.systems.common.progress import resumable
from splatpilot.systems.common.torch_device import require_renderer
from splatpilot.training.captures.capture import Capture
from splatpilot.training.captures.capture_registry import read_capture
from splatpilot.training.captures.check import doubts
from splatpilot.training.reconstruction.checkpoint import kept_work, work_folder
from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.reconstruct import ReconstructSummary, reconstruct


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
    if not _is_unmeasured(Path(out), opened):
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
    if not (scene / "scene.yaml").is_file() or (scene / SHEET).exists():
        return False
    metadata = read_scene_metadata(scene)
    made_of = metadata.capture, metadata.capture_settings
    return made_of == (capture.folder, capture.config.settings())
