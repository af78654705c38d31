"""How far from its capture's path a scene can be trusted: the study of the paper's Fig. 7.

Views beside the path are compared with the truth, which is exact where the capture was rendered
from a world, and otherwise given by stretches of frames that are withheld from a reconstruction
made for this. From it follows how far poses may be perturbed in training (Sec. IV-B).
"""

import csv
import io
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
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
    choose_withheld,
    displace_pose,
    drop_frames,
    first_crossing,
)
from splatpilot.analysis.reconstruction.figures import (
    Panel,
    depth_scale,
    error_scale,
    save,
    write_sheet,
)
from splatpilot.analysis.reconstruction.measure_scene import depth_panels
from splatpilot.analysis.reconstruction.scene_measures import SceneViews
from splatpilot.diagrams.worlds.scene_folder import (
    SceneMetadata,
    read_scene_metadata,
    write_scene_metadata,
)
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.common.config import dump_config
from splatpilot.systems.common.files import claim_folder, holds_folder, written_atomically
from splatpilot.systems.common.progress import Progress, resumable
from splatpilot.training.captures.capture import CaptureFrame
from splatpilot.training.captures.render import true_camera
from splatpilot.training.reconstruction.checkpoint import kept_work
from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.metrics import fit_exposure, mean_metric
from splatpilot.training.reconstruction.reconstruct import reconstruct


@dataclass(kw_only=True)
class FidelityConfig:
    """What is tried, and what counts as trusted."""

    offsets: list[float] = field(
        default_factory=lambda: [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0]
    )
    """[m], to the left and right of the path, in worlds that can be rendered."""
    clearance: float = 0.2
    """[m], that a displaced camera keeps from everything."""
    stretches: list[int] = field(default_factory=lambda: [1, 3, 7, 13])
    """Lengths of the stretches of frames that are withheld, in turn, where nothing can be
    rendered."""
    kept: int = 5
    """Frames kept between them."""
    max_depth_error: float = 0.05
    """Relative error of depth, mean over a view, of which the median view is still trusted."""
    max_psnr_drop: float = 6.0
    """[dB] below the held-out frames on the path that is still trusted: errors twice as large."""
    reconstruct: ReconstructConfig = field(default_factory=ReconstructConfig)
    """How to reconstruct without the withheld frames."""

    def validate(self) -> None:
        """Raises ValueError for values that make no sense."""
        self.reconstruct.validate()
        if sorted(set(self.offsets)) != self.offsets or not self.offsets or self.offsets[0] < 0:
            raise ValueError(f"offsets are {self.offsets}; at least one, rising from 0 is needed")
        if not self.stretches or min(self.stretches) < 1 or self.kept < 1:
            raise ValueError(
                f"stretches are {self.stretches} and kept is {self.kept}: at least 1 is needed"
            )
        for name in ("clearance", "max_depth_error", "max_psnr_drop"):
            if not 0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name} is {getattr(self, name)}, more than 0 is needed")


@dataclass
class StudiedScenes:
    """The content of `fidelity.yaml`: which study a folder holds."""

    scenes: dict[str, str] = field(default_factory=dict)
    """Folders of the scenes, and what each was made from."""
    config: FidelityConfig = field(default_factory=FidelityConfig)
    """What was tried, and what counts as trusted."""


_COLUMNS = 6
_ERROR_LIMIT = 0.2  # [m]


def write_curves(path: Path, studies: Sequence[FidelityStudy]) -> None:
    """Draws PSNR and depth errors of each scene against the offset from the path: medians with the
    10th to 90th percentile, the limits, and as a vertical line how far the medians keep them."""
    figure = Figure(figsize=(11, 3.6), dpi=150, layout="constrained")
    axes = figure.subplots(1, 3)
    panels = (
        ("psnr_db", "PSNR [dB]", 1.0),
        ("depth_mae_m", "depth MAE [m]", 1.0),
        ("depth_relative", "relative depth error [%]", 100.0),
    )
    for k, study in enumerate(studies):
        color = colormaps["tab10"](k)
        x = study.column("offset")
        for axis, (name, title, factor) in zip(axes, panels, strict=True):
            y = factor * study.column(name)
            axis.plot(x, y, ".", color=color, alpha=0.4, markersize=5, markeredgewidth=0)
            found = band(x, y)
            axis.fill_between(found.at, found.low, found.high, color=color, alpha=0.2, linewidth=0)
            axis.plot(found.at, found.middle, "o-", color=color, markersize=4, label=study.name)
            axis.axvline(study.reach, color=color, linestyle="--", linewidth=1)
            axis.set_ylabel(title)
        if len(studies) == 1:
            limit = study.on_path_psnr_db - study.max_psnr_drop
            axes[0].axhline(limit, color="black", linestyle=":", linewidth=1)
    axes[2].axhline(100 * studies[0].max_depth_error, color="black", linestyle=":", linewidth=1)
    kinds = {study.kind for study in studies}
    withheld = "distance to the nearest camera kept [m]"
    label = "lateral offset [m]" if kinds == {"rendered"} else withheld
    if len(kinds) > 1:
        label = "offset from the capture path [m]"
    for axis, (name, _, factor) in zip(axes, panels, strict=True):
        axis.set_xlabel(label)
        axis.grid(alpha=0.3)
        axis.set_xlim(left=0)
        if name != "psnr_db":
            top = max(np.percentile(factor * study.column(name), 92) for study in studies)
            axis.set_ylim(0, 1.1 * top)
    axes[0].legend(frameon=False)
    save(figure, path)


def write_views(
    path: Path, views: SceneViews, samples: Sequence[Sample], frames: Sequence[CaptureFrame]
) -> None:
    """Draws views at growing offset: the truth, the scene, its depth and the error of it."""
    order = np.argsort([sample.offset for sample in samples], kind="stable")
    picked = order[np.linspace(0, len(order) - 1, min(_COLUMNS, len(order))).astype(int)]
    depths = depth_scale([frames[k].depth for k in picked])
    errors = error_scale(_ERROR_LIMIT)
    rows: list[list[Panel]] = [[], [], [], []]
    for k in picked:
        frame, view = frames[k], views.render(frames[k])
        truth = frame.image / 255
        image, _ = fit_exposure(view.color, truth, views.metadata.vignetting, frame.valid)
        _, depth, error = depth_panels(frame, view, samples[k].depth_mae_m, depths, errors)
        panels = (Panel(truth), Panel(image, f"{samples[k].psnr_db:.1f} dB"), depth, error)
        for row, panel in zip(rows, panels, strict=True):
            row.append(panel)
    columns = [f"{samples[k].offset:.2f} m" for k in picked]
    titles = ["truth", "scene", "its depth", "depth error"]
    write_sheet(path, rows, columns, titles, [None, None, depths, errors])


TrueCamera = Callable[[RigidTransform], CaptureFrame]
"""Returns what the camera of a capture would have seen from another pose."""

_RECIPE = "reconstruct.yaml"
_GRID = 0.1  # [m], steps in which the surroundings of a pose are tried


@holds_folder("out")
def run(
    scenes: Sequence[Path],
    out: Path,
    config: FidelityConfig,
    find_camera: Callable[[Path], TrueCamera | None] = true_camera,
    overwrite: bool = False,
) -> list[FidelityStudy]:
    """Studies each scene folder, stores the bounds in its `scene.yaml` and writes figures.

    `find_camera` returns, for the folder of a capture that was rendered, the camera that can render
    the truth from anywhere, and None for others.

    `out` gets `fidelity.png`, `fidelity.csv` and, for each scene, a sheet of views. What is
    reconstructed without some frames is kept in `out/SCENE`, and used again; `fidelity.yaml` says
    which study it is. With `overwrite` it takes the place of another study in `out`, and its bounds
    that of another's in the scenes.

    Raises:
        FileNotFoundError, ValueError, OSError: for a scene that is damaged, has no capture with
            depth, bounds of another study, or the name of another one; settings that make no sense;
            something else in `out`, or a folder that cannot be written.
    """
    config.validate()
    names = [scene.resolve().name for scene in scenes]
    if len(set(names)) < len(names):
        raise ValueError(f"two scenes have one name ({', '.join(names)}); rename one folder")
    _claim(out, scenes, config, overwrite)
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
    _write_csv(out / "fidelity.csv", studies)
    return studies


def _claim(out: Path, scenes: Sequence[Path], config: FidelityConfig, overwrite: bool) -> None:
    """Makes `out` the folder of this study, and refuses to replace the bounds of another one."""
    file = out / "fidelity.yaml"
    said = {scene: read_scene_metadata(scene) for scene in scenes}
    for scene, metadata in said.items():
        if metadata.pose_perturbation_bounds and not file.is_file() and not overwrite:
            raise FileExistsError(
                f"{scene / 'scene.yaml'} has the bounds of another study; go on with that one in "
                "its --out, or replace them with --overwrite"
            )
    made_from = {str(scene.resolve()): metadata.provenance for scene, metadata in said.items()}
    claim_folder(file, StudiedScenes(made_from, config), overwrite)


def study_scene(
    scene: Path,
    out: Path,
    config: FidelityConfig,
    find_camera: Callable[[Path], TrueCamera | None] = true_camera,
) -> FidelityStudy:
    """Measures a scene beside the path of its capture; see `run`."""
    views = SceneViews(scene)
    capture = views.capture
    if not capture.has_depth or not capture.metric:
        raise ValueError(
            f"{scene}: its capture {capture.source} has no metric depth, without which no depth "
            "error can be measured"
        )
    # As beside the path, nothing is left out.
    on_path = (views.measure(views.frame(i)) for i in views.measured)
    on_path_psnr_db, _ = mean_metric(on_path, "psnr_db")
    assert on_path_psnr_db is not None
    camera = find_camera(Path(views.metadata.capture))
    if camera is not None:
        frames = _rendered_frames(views, scene, camera, config)
    else:
        views, frames = _withheld_frames(views, out, config)
    support = _support(views)
    samples, shown = [], []
    for i, offset, frame in frames:
        frame = views.shrink(frame)
        found = views.measure(frame)
        if found.depth_mae_m is None:
            continue
        if offset is None:
            offset = support.distance(frame.X_WC.translation())
        unseen = 1 - support.of(frame.X_WC)
        samples.append(Sample.of(i, offset, unseen, found))
        shown.append(frame)
    if len(samples) < 2:
        raise ValueError(
            f"{scene}: {len(samples)} views beside the path can be compared, at least 2 are "
            "needed; try smaller offsets, a smaller clearance or shorter stretches"
        )
    write_views(out.with_name(f"{out.name}_views.png"), views, samples, shown)
    return FidelityStudy(
        name=out.name,
        kind="withheld" if camera is None else "rendered",
        on_path_psnr_db=on_path_psnr_db,
        samples=samples,
        max_depth_error=config.max_depth_error,
        max_psnr_drop=config.max_psnr_drop,
    )


def pose_bounds(views: SceneViews, study: FidelityStudy) -> list[float]:
    """Returns how far each pose of the capture may be displaced [m].

    A pose may go left, right, up and down (`displace_pose`) as long as no more of its view is
    unseen than the study found to be within the limits, and at most as far as was measured.
    """
    support = _support(views)
    farthest = study.column("offset").max()
    grid = np.append(np.arange(0, farthest - 1e-9, _GRID), farthest)
    bounds = []
    X_WCs = views.capture.X_WCs
    for i in Progress(range(len(X_WCs)), "finding bounds", unit="pose"):
        sides = zip(*(displace_pose(X_WCs, i, offset) for offset in grid), strict=True)
        bounds.append(
            min(
                first_crossing(grid, (1 - support.of(X_WC) for X_WC in side), study.unseen_limit)
                for side in sides
            )
        )
    return bounds


def store_bounds(scene: Path, study: FidelityStudy) -> SceneMetadata:
    """Writes how far poses may be perturbed into `scene.yaml`: each pose, and any pose.

    The latter is the offset to which the median view stays within the limits where the truth was
    rendered; a few poses bear less, as their own bounds say. Withheld frames do not say this
    directly, for taking them away takes views away too: there it is the median over the poses.
    """
    bounds = pose_bounds(SceneViews(scene), study)
    metadata = replace(
        read_scene_metadata(scene),
        perturbation_bound=study.reach if study.kind == "rendered" else float(np.median(bounds)),
        pose_perturbation_bounds=bounds,
    )
    write_scene_metadata(scene, metadata)
    return metadata


def _write_csv(path: Path, studies: Sequence[FidelityStudy]) -> None:
    text = io.StringIO()
    names = [field.name for field in fields(Sample)]
    writer = csv.writer(text)
    writer.writerow(["scene", *names])
    for study in studies:
        writer.writerows([study.name, *asdict(sample).values()] for sample in study.samples)
    with written_atomically(path) as partial:
        partial.write_text(text.getvalue())


def _support(views: SceneViews) -> ViewSupport:
    capture = views.capture
    return ViewSupport(views.renderer, capture.K, capture.width, capture.height, views.fitted_poses)


def _rendered_frames(
    views: SceneViews, scene: Path, camera: TrueCamera, config: FidelityConfig
) -> Iterator[tuple[int, float, CaptureFrame]]:
    """Yields the truth at the held-out poses and beside them, wherever a camera fits."""
    esdf = Esdf.load(scene / "esdf.npz").conservative()
    X_WCs = views.capture.X_WCs
    numbers = views.metadata.held_out or range(len(X_WCs))
    for i in Progress(numbers, "rendering the truth", unit="pose"):
        for offset in config.offsets:
            for X_WC in displace_pose(X_WCs, i, offset)[: 2 if offset else 1]:
                way = np.linspace(X_WCs[i].translation(), X_WC.translation(), 11)
                if offset and esdf.distance(way[1:]).min() < config.clearance:
                    continue
                yield i, offset, camera(X_WC)


def _withheld_frames(
    views: SceneViews, out: Path, config: FidelityConfig
) -> tuple[SceneViews, Iterator[tuple[int, None, CaptureFrame]]]:
    """Reconstructs without stretches of frames and yields those."""
    whole = views.capture
    withheld = choose_withheld(len(whole), config.stretches, config.kept)
    representation = views.metadata.representation
    settings = replace(config.reconstruct, representation=representation, hold_out=0)
    recipe = f"{dump_config(settings)}withheld: {withheld}\n"
    file = out / _RECIPE
    part = drop_frames(whole, withheld)
    if not file.is_file() or file.read_text() != recipe:
        with resumable(lambda: kept_work(out)):
            reconstruct(part, out, settings)
        with written_atomically(file) as partial:
            partial.write_text(recipe)
    measured = Progress(withheld, "measuring held-out frames", unit="frame")
    frames = ((i, None, whole.frame(i)) for i in measured)
    return SceneViews(out, part), frames
