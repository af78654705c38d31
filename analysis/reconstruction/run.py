"""`splatpilot reconstruct`: a capture becomes a scene folder with metrics."""

from dataclasses import replace
from pathlib import Path

from splatpilot.analysis.reconstruction.measure_scene import VIEWS, SceneMetrics, measure_scene
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
    """Reconstructs the capture in a folder as the scene folder `out`, measures it and prints the
    results; see `reconstruct` and `measure_scene`. With `overwrite` it replaces another scene.

    Raises:
        FileNotFoundError, ValueError, OSError: as `reconstruct`.
    """
    out = Path(out)
    # Before photographs are registered, which takes minutes.
    config.validate()
    require_renderer(config.device)
    check_scene_target(out)
    if (out / VIEWS).exists():
        require_unused(out, overwrite)
    opened = read_capture(capture, config.capture)
    if not _is_unmeasured(out, opened):
        require_unused(out, overwrite)
    doubted = doubts(opened)
    for doubt in doubted:  # at once, and again in the summary
        print(f"warning: {doubt}", flush=True)
    with held_folder(work_folder(out)):
        with resumable(lambda: kept_work(out)):
            summary = reconstruct(opened, out, config, restart=restart)
        summary = replace(summary, warnings=(*doubted, *summary.warnings))
        print(summary)
        with resumable(lambda: f"{out} is made, but not measured; the same command measures it"):
            metrics = measure_scene(out, opened)
        print(metrics)
    return summary, metrics


def _is_unmeasured(scene: Path, capture: Capture) -> bool:
    """Tells whether an interrupted run left this scene of the capture without metrics."""
    if not (scene / "scene.yaml").is_file() or (scene / VIEWS).exists():
        return False
    metadata = read_scene_metadata(scene)
    source = metadata.capture, metadata.capture_settings
    return source == (capture.folder, capture.config.settings())
