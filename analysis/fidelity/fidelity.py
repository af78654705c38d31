"""Fidelity of scenes off the path of their capture, the study of the paper's Fig. 7.

The truth is rendered, if the capture was, or frames that a reconstruction leaves out.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure
from pydrake.math import RigidTransform

from splatpilot.analysis.fidelity.study import (
    FidelityStudy,
    Sample,
    ViewSupport,
    band,
    choose_held_out,
    displace_pose,
    drop_frames,
    first_crossing,
)
from splatpilot.analysis.figures import depth_scale, error_scale, write_grid, write_png
from splatpilot.analysis.reconstruction.measure_scene import SceneViews
from splatpilot.diagrams.worlds.scene_folder import (
    SceneMetadata,
    read_scene_metadata,
    write_scene_metadata,
)
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.common.config import dump_config
from splatpilot.systems.common.files import claim_folder, locks_folder, write_csv, write_text
from splatpilot.systems.common.progress import Progress, resumable
from splatpilot.systems.common.validation import Config, bounded, require_field
from splatpilot.training.captures.capture import CaptureFrame, shrink
from splatpilot.training.captures.render import true_camera
from splatpilot.training.reconstruction.checkpoint import kept_work
from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.metrics import mean_metric
from splatpilot.training.reconstruction.reconstruct import reconstruct

TrueCamera = Callable[[RigidTransform], CaptureFrame]
"""Renders the true frame of a capture's camera at another pose."""

_RECIPE = "reconstruct.yaml"
_METRICS = ("psnr_db", "depth_mae_m", "depth_relative", "floater_fraction")
_STEP = 0.1  # [m], between displacements of a pose
_MAX_COLUMNS = 6  # of the image grid
_ERROR_LIMIT = 0.2  # [m], brightest color of depth errors


@dataclass(kw_only=True)
class FidelityConfig(Config):
    """Views of a study, and the limits of trusted ones."""

    offsets: list[float] = bounded(
        lambda: [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0], "[0, inf) m"
    )
    """[m], left and right of the path, if the truth can be rendered."""
    clearance: float = bounded(0.2, "(0, inf) m")
    """[m], minimum distance of displaced cameras from obstacles."""
    stretches: list[int] = bounded(lambda: [1, 3, 7, 13], "[1, inf)")
    """Lengths of the stretches of frames that are held out in turn, if it cannot."""
    kept: int = bounded(5, "[1, inf)")
    """Number of frames kept between stretches."""
    max_depth_error: float = bounded(0.05, "(0, inf)")
    """Relative depth error, mean over a view, up to which the median view is trusted."""
    max_psnr_drop: float = bounded(6.0, "(0, inf) dB")
    """[dB] below the held-out frames on the path; 6 dB are twice the error."""
    reconstruct: ReconstructConfig = field(default_factory=ReconstructConfig)
    """Reconstruction without the held-out frames."""

    def check(self) -> None:
        rising = self.offsets and sorted(set(self.offsets)) == self.offsets
        require_field(self, "offsets", rising, "at least one, rising")
        require_field(self, "stretches", self.stretches, "at least one")


@dataclass
class StudiedScenes:
    """The content of `fidelity.yaml`."""

    scenes: dict[str, str] = field(default_factory=dict)
    """Folders of the scenes, and their provenance."""
    config: FidelityConfig = field(default_factory=FidelityConfig)


@locks_folder("out")
def run(
    scenes: Sequence[Path],
    out: Path,
    config: FidelityConfig,
    find_camera: Callable[[Path], TrueCamera | None] = true_camera,
    overwrite: bool = False,
) -> list[FidelityStudy]:
    """Studies scene folders, and writes the bounds into their `scene.yaml` and `fidelity.png`,
    `fidelity.csv`, `fidelity.yaml` and image grids into `out`. `find_camera` returns the camera
    that renders the truth of a capture's folder, or None."""
    config.validate()
    names = [scene.resolve().name for scene in scenes]
    if len(set(names)) < len(names):
        raise ValueError(f"two scenes have one name ({', '.join(names)}); rename one folder")
    file = out / "fidelity.yaml"
    metadata = {scene: read_scene_metadata(scene) for scene in scenes}
    for scene, about in metadata.items():
        if about.pose_perturbation_bounds and not file.is_file() and not overwrite:
            raise FileExistsError(
                f"{scene / 'scene.yaml'} has the bounds of another study; resume that one in its "
                "--out, or replace them with --overwrite"
            )
    sources = {str(scene.resolve()): about.provenance for scene, about in metadata.items()}
    claim_folder(file, StudiedScenes(sources, config), overwrite)
    studies = []
    kept = f"what was reconstructed is in {out}; the same command uses it again"
    with resumable(lambda: kept):
        for scene, name in zip(scenes, names, strict=True):
            study = study_scene(scene, out / name, config, find_camera)
            bounds = store_bounds(scene, study)
            low, middle, high = np.percentile(bounds.pose_perturbation_bounds, [10, 50, 90])
            print(study)
            print(
                f"perturbation bound {bounds.perturbation_bound:.2f} m; of single poses {low:.2f}, "
                f"{middle:.2f}, {high:.2f} m (10, 50, 90 %)"
            )
            studies.append(study)
    write_curves(out / "fidelity.png", studies)
    rows = ({"scene": study.name} | asdict(s) for study in studies for s in study.samples)
    write_csv(out / "fidelity.csv", rows)
    return studies


def study_scene(
    scene: Path,
    out: Path,
    config: FidelityConfig,
    find_camera: Callable[[Path], TrueCamera | None] = true_camera,
) -> FidelityStudy:
    """Measures a scene off the path of its capture; see `run`."""
    views = SceneViews(scene)
    capture = views.capture
    if not capture.has_depth or not capture.metric:
        raise ValueError(f"{scene}: its capture {capture.source} has no metric depth to compare")
    # Over all pixels, as off the path.
    on_path = (views.measure(views.frame(i)) for i in views.measured)
    on_path_psnr_db, _ = mean_metric(on_path, "psnr_db")
    assert on_path_psnr_db is not None
    camera = find_camera(Path(views.metadata.capture))
    if camera is not None:
        frames = _rendered_frames(views, scene, camera, config)
    else:
        views, frames = _held_out_frames(views, out, config)
    support = _support(views)
    samples, shown = [], []
    for i, offset, frame in frames:
        frame = shrink(frame, views.factor)
        found = vars(views.measure(frame))
        if found["depth_mae_m"] is None:
            continue
        if offset is None:
            offset = support.distance(frame.X_WC.translation())
        metrics = {name: found[name] for name in _METRICS}
        samples.append(Sample(i, offset, 1 - support.fraction(frame.X_WC), **metrics))
        shown.append(frame)
    if len(samples) < 2:
        raise ValueError(
            f"{scene}: {len(samples)} views off the path can be compared, at least 2 are required; "
            "try smaller offsets, a smaller clearance or shorter stretches"
        )
    write_views(out.with_name(f"{out.name}_views.png"), views, samples, shown)
    return FidelityStudy(
        name=out.name,
        kind="held-out" if camera is None else "rendered",
        on_path_psnr_db=on_path_psnr_db,
        samples=samples,
        max_depth_error=config.max_depth_error,
        max_psnr_drop=config.max_psnr_drop,
    )


def store_bounds(scene: Path, study: FidelityStudy) -> SceneMetadata:
    """Writes the maximum displacement [m] of each pose, and of all poses, into `scene.yaml`.

    A pose may move left, right, up and down while its view keeps within the study's limit of unseen
    pixels, at most as far as was measured. The bound of all poses is the reach or, of held-out
    frames, the median over the poses.
    """
    views = SceneViews(scene)
    support, X_WCs = _support(views), views.capture.X_WCs
    farthest = study.column("offset").max()
    grid = np.append(np.arange(0, farthest - 1e-9, _STEP), farthest)
    bounds = []
    for i in Progress(range(len(X_WCs)), "finding bounds", unit="pose"):
        sides = zip(*(displace_pose(X_WCs, i, offset) for offset in grid), strict=True)
        unseen = ((1 - support.fraction(X_WC) for X_WC in side) for side in sides)
        bounds.append(min(first_crossing(grid, values, study.unseen_limit) for values in unseen))
    metadata = replace(
        read_scene_metadata(scene),
        perturbation_bound=study.reach if study.kind == "rendered" else float(np.median(bounds)),
        pose_perturbation_bounds=bounds,
    )
    write_scene_metadata(scene, metadata)
    return metadata


def _support(views: SceneViews) -> ViewSupport:
    capture = views.capture
    camera = capture.K, capture.width, capture.height
    return ViewSupport(views.renderer, camera, [capture.X_WCs[i] for i in views.fitted])


def _rendered_frames(
    views: SceneViews, scene: Path, camera: TrueCamera, config: FidelityConfig
) -> Iterator[tuple[int, float, CaptureFrame]]:
    """Yields true frames at the held-out poses and beside them, if a camera fits there."""
    esdf = Esdf.load(scene / "esdf.npz").conservative()
    X_WCs = views.capture.X_WCs
    indices = views.metadata.held_out or range(len(X_WCs))
    for i in Progress(indices, "rendering the truth", unit="pose"):
        for offset in config.offsets:
            for X_WC in displace_pose(X_WCs, i, offset)[: 2 if offset else 1]:
                path = np.linspace(X_WCs[i].translation(), X_WC.translation(), 11)
                if offset and esdf.distance(path[1:]).min() < config.clearance:
                    continue
                yield i, offset, camera(X_WC)


def _held_out_frames(
    views: SceneViews, out: Path, config: FidelityConfig
) -> tuple[SceneViews, Iterator[tuple[int, None, CaptureFrame]]]:
    """Reconstructs without stretches of frames and yields those."""
    capture = views.capture
    held_out = choose_held_out(len(capture), config.stretches, config.kept)
    representation = views.metadata.representation
    settings = replace(config.reconstruct, representation=representation, hold_out=0)
    recipe = f"{dump_config(settings)}held_out: {held_out}\n"
    file = out / _RECIPE
    part = drop_frames(capture, held_out)
    if not file.is_file() or file.read_text() != recipe:
        with resumable(lambda: kept_work(out)):
            reconstruct(part, out, settings)
        write_text(file, recipe)
    measured = Progress(held_out, "measuring held-out frames", unit="frame")
    return SceneViews(out, part), ((i, None, capture.frame(i)) for i in measured)


def write_curves(path: Path, studies: Sequence[FidelityStudy]) -> None:
    """Draws PSNR and depth errors of each scene against the offset from the path: medians with the
    10th to 90th percentile, the limits, and the reach as a vertical line."""
    figure = Figure(figsize=(11, 3.6), layout="constrained")
    axes = figure.subplots(1, 3)
    panels = (
        ("psnr_db", "PSNR [dB]", 1.0),
        ("depth_mae_m", "depth MAE [m]", 1.0),
        ("depth_relative", "relative depth error [%]", 100.0),
    )
    for axis, (name, title, factor) in zip(axes, panels, strict=True):
        for k, study in enumerate(studies):
            color = colormaps["tab10"](k)
            x, y = study.column("offset"), factor * study.column(name)
            axis.plot(x, y, ".", color=color, alpha=0.4, markersize=5, markeredgewidth=0)
            found = band(x, y)
            axis.fill_between(found.at, found.low, found.high, color=color, alpha=0.2, linewidth=0)
            axis.plot(found.at, found.middle, "o-", color=color, markersize=4, label=study.name)
            axis.axvline(study.reach, color=color, linestyle="--", linewidth=1)
        axis.set_xlabel("offset from the capture path [m]")
        axis.set_ylabel(title)
        axis.grid(alpha=0.3)
        axis.set_xlim(left=0)
        if name != "psnr_db":
            top = max(np.percentile(factor * study.column(name), 92) for study in studies)
            axis.set_ylim(0, 1.1 * top or None)
    limit = {"color": "black", "linestyle": ":", "linewidth": 1}
    if len(studies) == 1:
        axes[0].axhline(studies[0].on_path_psnr_db - studies[0].max_psnr_drop, **limit)
    axes[2].axhline(100 * studies[0].max_depth_error, **limit)
    axes[0].legend(frameon=False)
    write_png(figure, path, dpi=150)


def write_views(
    path: Path, views: SceneViews, samples: Sequence[Sample], frames: Sequence[CaptureFrame]
) -> None:
    """Writes an image grid of views at growing offset: truth, scene, its depth and depth error."""
    order = np.argsort([sample.offset for sample in samples], kind="stable")
    picked = order[np.linspace(0, len(order) - 1, min(_MAX_COLUMNS, len(order))).astype(int)]
    depths, errors = depth_scale([frames[k].depth for k in picked]), error_scale(_ERROR_LIMIT)
    columns = []
    for k in picked:
        sample = samples[k]
        labels = f"{sample.psnr_db:.1f} dB", f"{100 * sample.depth_mae_m:.1f} cm"
        truth, image, _, *depth = views.panels(frames[k], depths, errors, labels)
        columns.append([truth, image, *depth])
    write_grid(
        path,
        list(zip(*columns, strict=True)),
        [f"{samples[k].offset:.2f} m" for k in picked],
        ["truth", "scene", "its depth", "depth error"],
        [None, None, depths, errors],
    )
