"""Fidelity of scenes off the path of their capture, the study of the paper's Fig. 7.

The truth is rendered, if the capture was, or frames that a reconstruction leaves out.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from itertools import cycle
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray
from pydrake.math import RigidTransform
from scipy.optimize import isotonic_regression

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
from splatpilot.systems.splats.background import EnvironmentMap
from splatpilot.training.captures.capture import (
    Capture,
    CaptureFrame,
    back_project,
    no_depth,
    project_points,
    shrink,
)
from splatpilot.training.captures.render import true_camera
from splatpilot.training.reconstruction.checkpoint import kept_work
from splatpilot.training.reconstruction.config import HOLD_OUT, ReconstructConfig
from splatpilot.training.reconstruction.metrics import mean_metric
from splatpilot.training.reconstruction.reconstruct import reconstruct
from splatpilot.training.reconstruction.splat_rendering import SceneRenderer

_MAX_GROUPS, _PER_GROUP = 16, 5  # of samples; minimum number of samples in a group
# Views of `ViewSupport`: width [px], closest cameras that are compared, relative difference of
# depth on the same surface, cosine of the angle between rays to a point, ratio of distances to it.
_WIDTH, _CAMERAS, _DEPTH_TOLERANCE = 48, 16, 0.05
_MIN_COSINE, _MAX_RATIO = np.cos(np.deg2rad(45)), 2.0


@dataclass(frozen=True)
class Band:
    """Groups of samples of similar x, in rising order: mean x, number, and the 10th, 50th and 90th
    percentile of y."""

    at: NDArray[np.float64]
    counts: NDArray[np.int64]
    low: NDArray[np.float64]
    middle: NDArray[np.float64]
    high: NDArray[np.float64]


def band(x: ArrayLike, y: ArrayLike) -> Band:
    """Groups samples by x: one for each value or, if more, up to 16 of equally many, at least 5."""
    x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
    values, which = np.unique(np.round(x, 6), return_inverse=True)
    if len(values) <= _MAX_GROUPS:
        groups = [np.flatnonzero(which == k) for k in range(len(values))]
    else:
        count = min(_MAX_GROUPS, max(1, len(x) // _PER_GROUP))
        groups = np.array_split(np.argsort(x, kind="stable"), count)
    low, middle, high = np.array([np.percentile(y[group], [10, 50, 90]) for group in groups]).T
    at = np.array([x[group].mean() for group in groups])
    return Band(at, np.array([len(group) for group in groups]), low, middle, high)


def reach(x: ArrayLike, y: ArrayLike, limit: float) -> float:
    """Returns the `first_crossing` of the non-decreasing least-squares fit to medians of `band`."""
    found = band(x, y)
    fit = isotonic_regression(found.middle, weights=found.counts).x
    return first_crossing(found.at, fit, limit)


def first_crossing(x: ArrayLike, y: Iterable[float], limit: float) -> float:
    """Returns the rising x up to which the values y, linear in between and taken one by one, are
    within `limit`; 0 if the first is not."""
    x = np.asarray(x, np.float64)
    before = 0.0
    for k, value in enumerate(y):
        if value > limit:
            step = (limit - before) / (value - before)
            return float(x[k - 1] + (x[k] - x[k - 1]) * step) if k else 0.0
        before = value
    return float(x[-1])


@dataclass(frozen=True)
class Sample:
    """One view off the path."""

    frame: int  # index of the displaced or held-out frame
    offset: float  # [m] from the path, or from the closest fitted camera
    unseen: float  # fraction of the view, see `ViewSupport`
    psnr_db: float
    depth_mae_m: float
    depth_relative: float
    floater_fraction: float


@dataclass(frozen=True)
class FidelityStudy:
    """The samples of one scene and their evaluation."""

    name: str
    kind: str
    """Source of the truth: "rendered", or "held-out" frames."""
    on_path_psnr_db: float  # of the held-out frames on the path
    samples: list[Sample]
    max_depth_error: float
    max_psnr_drop: float

    def column(self, name: str) -> NDArray:
        """Returns a field of all samples."""
        return np.array([getattr(sample, name) for sample in self.samples])

    @cached_property
    def reach(self) -> float:
        """[m], the largest offset at which the median view is within the limits."""
        return self._reach("offset")

    @cached_property
    def unseen_limit(self) -> float:
        """The largest unseen fraction at which the median view is within the limits."""
        return self._reach("unseen")

    def _reach(self, name: str) -> float:
        x = self.column(name)
        return min(
            reach(x, self.column("depth_relative"), self.max_depth_error),
            reach(x, self._psnr_drop, self.max_psnr_drop),
        )

    @property
    def _psnr_drop(self) -> NDArray:
        return self.on_path_psnr_db - self.column("psnr_db")

    def agreement(self) -> tuple[float, float]:
        """Returns the fraction of views within the limits, of those with an unseen fraction up to
        `unseen_limit` and of the others; NaN without any."""
        kept = self.column("depth_relative") <= self.max_depth_error
        kept &= self._psnr_drop <= self.max_psnr_drop
        trusted = self.column("unseen") <= self.unseen_limit
        both = (kept[trusted], kept[~trusted])
        inside, outside = (float(k.mean()) if len(k) else float("nan") for k in both)
        return inside, outside

    def __str__(self) -> str:
        lines = [
            f"{self.name}: {len(self.samples)} views, truth {self.kind}; on the path "
            f"{self.on_path_psnr_db:.2f} dB; medians and 10 to 90 % of the views",
            f"{'offset [m]':>10} {'views':>6} {'PSNR [dB]':>21} {'depth MAE [m]':>24} "
            f"{'relative [%]':>20}",
        ]
        x = self.column("offset")
        bands = [
            band(x, factor * self.column(name))
            for name, factor in (("psnr_db", 1), ("depth_mae_m", 1), ("depth_relative", 100))
        ]
        for k, (at, count) in enumerate(zip(bands[0].at, bands[0].counts, strict=True)):
            psnr, mae, relative = (
                f"{b.middle[k]:.{digits}f} ({b.low[k]:.{digits}f} to {b.high[k]:.{digits}f})"
                for b, digits in zip(bands, (1, 3, 1), strict=True)
            )
            lines.append(f"{at:>10.2f} {count:>6} {psnr:>21} {mae:>24} {relative:>20}")
        inside, outside = self.agreement()
        lines += [
            f"the median view is within limits to {self.reach:.2f} m: depth errors up to "
            f"{self.max_depth_error:.0%} and PSNR up to {self.max_psnr_drop:g} dB lower",
            f"trusted views: those seen to {1 - self.unseen_limit:.0%} or more; {inside:.0%} of "
            f"them keep these limits, {outside:.0%} of the others",
        ]
        return "\n".join(lines)


def choose_held_out(frames: int, stretches: Sequence[int], kept: int) -> list[int]:
    """Returns the held-out frames: stretches of these lengths in turn, `kept` frames apart."""
    held_out: list[int] = []
    start = kept
    for length in cycle(stretches):
        if start + length + kept > frames:
            break
        held_out += range(start, start + length)
        start += length + kept
    if not held_out:
        raise ValueError(
            f"{frames} frames are too few to hold out {stretches[0]} between {kept} that are kept; "
            "hold out shorter stretches"
        )
    return held_out


def drop_frames(capture: Capture, held_out: Sequence[int]) -> Capture:
    """Returns the capture without some of its frames."""
    kept = sorted(set(range(len(capture))).difference(held_out))
    return replace(
        capture,
        X_WCs=[capture.X_WCs[i] for i in kept],
        load_image=lambda k: capture.load_image(kept[k]),
        load_depth=(lambda k: capture.load_depth(kept[k])) if capture.has_depth else no_depth,
        load_valid=lambda k: capture.load_valid(kept[k]),
        held_out=None,
        frame_names=[capture.frame_names[i] for i in kept] if capture.frame_names else (),
        folder="",
    )


def displace_pose(X_WCs: Sequence[RigidTransform], i: int, offset: float) -> list[RigidTransform]:
    """Returns pose i of a path moved by `offset` [m] left, right, up and down. Left is horizontal
    and perpendicular to the path or, if that is vertical or at rest, along the camera's -x axis."""
    before, after = X_WCs[max(i - 1, 0)], X_WCs[min(i + 1, len(X_WCs) - 1)]
    path = after.translation() - before.translation()
    left = np.array([-path[1], path[0], 0.0])
    if np.linalg.norm(left) < 0.5 * np.linalg.norm(path) or not path.any():
        left = -X_WCs[i].rotation().matrix()[:, 0]
    left = offset * left / np.linalg.norm(left)
    up = np.array([0.0, 0.0, offset])
    R_WC, p_WC = X_WCs[i].rotation(), X_WCs[i].translation()
    return [RigidTransform(R_WC, p_WC + step) for step in (left, -left, up, -up)]


class ViewSupport:
    """The fraction of a view's pixels whose surface one of the 16 closest fitted cameras saw at the
    depth of the scene (within 5 %), from a direction within 45 degrees and at most twice the
    distance. `camera` is K (3, 3), width and height [px]; pixels without a surface count, unless
    the capture saw the sky."""

    def __init__(
        self,
        renderer: SceneRenderer,
        camera: tuple[NDArray, int, int],
        X_WCs: Sequence[RigidTransform],
        has_sky: bool = False,
    ):
        K, width, height = camera
        self._has_sky = has_sky
        shrunk = _WIDTH / width
        self._K = K.copy()
        self._K[:2] *= shrunk
        self._height = max(1, round(height * shrunk))
        self._renderer = renderer
        self._X_WCs = list(X_WCs)
        self._p_WCs = np.array([X_WC.translation() for X_WC in X_WCs])  # (n, 3)
        self._depths: dict[int, NDArray] = {}

    def fraction(self, X_WC: RigidTransform) -> float:
        """Returns the fraction, 0 to 1, for the camera at `X_WC`."""
        depth = self._render(X_WC)
        rows, columns = np.nonzero(depth > 0)
        z = depth[rows, columns].astype(np.float64)
        p_WQ = X_WC.multiply(back_project(self._K, columns + 0.5, rows + 0.5, z).T)  # (3, m)
        ray = p_WQ - X_WC.translation()[:, None]
        unseen = np.arange(len(z))
        distances = np.linalg.norm(self._p_WCs - X_WC.translation(), axis=1)
        for i in np.argsort(distances, kind="stable")[:_CAMERAS]:
            unseen = unseen[~self._sees(i, p_WQ[:, unseen], ray[:, unseen])]
        count = len(z) if self._has_sky else depth.size
        return float((len(z) - len(unseen)) / max(count, 1))

    def distance(self, p_WC: ArrayLike) -> float:
        """Returns the distance to the closest camera [m]."""
        return float(np.linalg.norm(self._p_WCs - np.asarray(p_WC), axis=1).min())

    def _sees(self, i: int, p_WQ: NDArray, ray: NDArray) -> NDArray[np.bool_]:
        """Returns which of the points (3, m) camera i saw like a camera with these rays to them."""
        p_CQ = self._X_WCs[i].inverse().multiply(p_WQ).T
        inside, rows, columns = project_points(self._K, p_CQ, _WIDTH, self._height)
        if i not in self._depths:
            self._depths[i] = self._render(self._X_WCs[i])
        z, ray = p_CQ[inside, 2], ray[:, inside]
        other_ray = p_WQ[:, inside] - self._p_WCs[i][:, None]
        distance, other_distance = (np.linalg.norm(r, axis=0) for r in (ray, other_ray))
        cosine = (ray * other_ray).sum(axis=0) / np.maximum(distance * other_distance, 1e-12)
        same = np.abs(self._depths[i][rows, columns] - z) <= _DEPTH_TOLERANCE * z
        near = other_distance <= _MAX_RATIO * distance
        inside[inside] = same & near & (cosine >= _MIN_COSINE)
        return inside

    def _render(self, X_WC: RigidTransform) -> NDArray[np.float32]:
        return self._renderer.render(self._K, _WIDTH, self._height, X_WC).depth


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
    """Studies scene folders; writes bounds into their `scene.yaml`, and tables, curves and image
    grids into `out`. `find_camera` returns the camera that renders the truth of a capture, if any.
    """
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
    with resumable(lambda: f"what was reconstructed is in {out}; the same command uses it again"):
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
    camera = find_camera(Path(views.metadata.capture))
    if camera is not None:
        frames = _rendered_frames(views, scene, camera, config)
    else:
        views, frames = _held_out_frames(views, out, config)
    # Over all pixels, as off the path, and of the same reconstruction.
    on_path = (views.measure(views.frame(i)) for i in views.measured)
    on_path_psnr_db, _ = mean_metric(on_path, "psnr_db")
    assert on_path_psnr_db is not None
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
    """Writes into `scene.yaml` how far [m] each pose may move left, right, up and down.

    Farther, more pixels are unseen than the study allows, or nothing was measured. The bound of all
    poses is the reach or, of held-out frames, the median.
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
    X_WCs = [capture.X_WCs[i] for i in views.fitted]
    return ViewSupport(views.renderer, camera, X_WCs, isinstance(views.background, EnvironmentMap))


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
                frame = camera(RigidTransform(views.capture.origin) @ X_WC)
                yield i, offset, replace(frame, X_WC=X_WC)


def _held_out_frames(
    views: SceneViews, out: Path, config: FidelityConfig
) -> tuple[SceneViews, Iterator[tuple[int, None, CaptureFrame]]]:
    """Reconstructs without stretches of frames and yields those."""
    capture = views.capture
    held_out = choose_held_out(len(capture), config.stretches, config.kept)
    representation = views.metadata.representation
    settings = replace(config.reconstruct, representation=representation, hold_out=HOLD_OUT)
    part = drop_frames(capture, held_out)
    recipe = f"{dump_config(settings)}held_out: {held_out}\ncameras: {part.camera_digest()}\n"
    file = out / _RECIPE
    if not file.is_file() or file.read_text() != recipe:
        with resumable(lambda: kept_work(out)):
            reconstruct(part, out, settings)
        write_text(file, recipe)
    measured = Progress(held_out, "measuring held-out frames", unit="frame")
    return SceneViews(out, part), ((i, None, capture.frame(i)) for i in measured)


def write_curves(path: Path, studies: Sequence[FidelityStudy]) -> None:
    """Draws PSNR and depth errors against the offset from the path: bands, limits and reach."""
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
