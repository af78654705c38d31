"""From the folder of a capture to a scene folder that has been measured."""

from pathlib import Path

from splatpilot.analysis.reconstruction.measure_scene import measure_scene
from splatpilot.analysis.reconstruction.scene_measures import SceneMeasures
from splatpilot.diagrams.worlds.scene_folder import check_scene_target
from splatpilot.systems.files import held_folder, require_unused
from splatpilot.training.captures.read_capture import read_capture
from splatpilot.training.device import require_renderer
from splatpilot.training.reconstruction.checkpoint import work_folder
from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.reconstruct import ReconstructSummary, reconstruct


def run(
    *,
    capture: str | Path,
    out: str | Path,
    config: ReconstructConfig,
    restart: bool = False,
    overwrite: bool = False,
) -> tuple[ReconstructSummary, SceneMeasures]:
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
    require_unused(Path(out), overwrite)
    opened = read_capture(capture, config.capture)
    with held_folder(work_folder(Path(out))):
        summary = reconstruct(opened, out, config, restart=restart)
        print(summary)
        measures = measure_scene(Path(out), opened)
        print(measures)
    return summary, measures
