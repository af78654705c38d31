"""Reconstruction of a capture as a scene folder."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatpilot.diagrams.worlds.feasibility import choose_start_and_goal, short_route_warning
from splatpilot.diagrams.worlds.observed_routes import (
    MAX_UNOBSERVED,
    ObservedRoute,
    choose_default_route,
    with_views,
)
from splatpilot.diagrams.worlds.scene_folder import (
    SceneMetadata,
    check_scene_target,
    close_frontier,
    write_scene_folder,
)
from splatpilot.diagrams.worlds.splits import choose_split, part_digests, source_digest
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.observations import Observations
from splatpilot.systems.common.config import dump_config
from splatpilot.systems.common.files import write_text
from splatpilot.systems.common.processes import one_torch_thread
from splatpilot.systems.common.progress import Progress
from splatpilot.systems.common.provenance import InfeasibleFlightError
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.training.captures.capture import Capture, shrink_factor
from splatpilot.training.captures.render import RECIPE, rendered_world
from splatpilot.training.reconstruction.checkpoint import Checkpoint
from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.distance_field import make_distance_field
from splatpilot.training.reconstruction.initialize import (
    gaussians_from_depth,
    held_out_frames,
    make_initial_gaussians,
    resolve_config,
)
from splatpilot.training.reconstruction.metrics import HeldOutMetrics, Lpips
from splatpilot.training.reconstruction.optimize import Optimization
from splatpilot.training.reconstruction.photometry import (
    Photometry,
    ThinnedFrame,
    estimate_photometry,
    predict_gains,
)
from splatpilot.training.reconstruction.views import (
    ReconstructionViews,
    ShrunkFrames,
    learn_background,
)

SETTINGS = "reconstruct.yaml"
_MAX_NAMED = 10  # frames in a warning


@dataclass(frozen=True)
class ReconstructSummary:
    """A reconstructed scene."""

    scene: Path
    metadata: SceneMetadata
    gaussians: int
    voxel_size: float
    route: ObservedRoute  # default start and goal; of length NaN if the scene cannot be flown in
    held_out: HeldOutMetrics | None
    warnings: tuple[str, ...]

    def __str__(self) -> str:
        def vector(p: NDArray) -> str:
            return "(" + ", ".join(f"{x:.2f}" for x in p) + ")"

        about = self.metadata
        unit = "m" if about.metric else "units of an unknown length"
        lower_W, upper_W = np.array(about.lower_W), np.array(about.upper_W)
        size = " x ".join(f"{length:.3g}" for length in upper_W - lower_W)
        gains = np.delete(about.gains, about.held_out)
        rows = {
            "scene": self.scene,
            "frames": len(about.gains),
            "Gaussians": self.gaussians,
            "size": f"{size} {unit}, from {vector(lower_W)} to {vector(upper_W)}",
            "distance field": f"voxels of {self.voxel_size:.2g} {unit}",
            "image gains": f"{gains.min():.3f} to {gains.max():.3f}",
            "corner brightness": f"{np.exp(about.vignetting):.3f}",
        }
        if about.metric:
            rows["seen free [m^3]"] = f"{about.observed_free_volume:.1f}"
        if np.isfinite(self.route.length):
            rows |= {
                "default start [m]": vector(self.route.p_WS),
                "default goal [m]": vector(self.route.p_WG),
                "shortest path [m]": f"{self.route.length:.1f}",
                "unobserved on it": f"{self.route.unobserved:.1%} of a camera's pixels",
            }
        if self.held_out is not None:
            rows["held-out frames"] = self.held_out
        lines = [f"{name:<18} {value}" for name, value in rows.items()]
        lines += [f"note: {note}" for note in about.capture_notes]
        return "\n".join(lines + [f"warning: {warning}" for warning in self.warnings])


@one_torch_thread()
def reconstruct(
    capture: Capture, out: str | Path, config: ReconstructConfig, *, restart: bool = False
) -> ReconstructSummary:
    """Reconstructs a capture as the scene folder `out`. Checkpoints are in `.NAME.partial` next to
    it, from which, unless `restart`, the same call resumes to the bitwise identical scene."""
    out = Path(out)
    config.validate()
    check_scene_target(out)
    config = resolve_config(config, capture)
    if not restart and config.iterations:
        Checkpoint(out, config).load()  # raises ValueError before anything slow is prepared
    held_out = held_out_frames(capture, config)
    fitted = [i for i in range(len(capture)) if i not in held_out]
    factor = shrink_factor(capture.width, config.image_width if config.iterations else 0)
    digests: set[str] = set()
    frames = ShrunkFrames(_digested(capture, digests), fitted, factor)
    thinned = [ThinnedFrame.of(f) for f in Progress(frames, "comparing brightness", unit="frame")]
    source, split = _source_and_split(capture, digests, config.split)
    photometry = estimate_photometry(thinned, config.seed)
    without_depth = _without_depth(capture, fitted, thinned)
    del thinned
    background = learn_background(frames, photometry)
    gains = np.ones(len(capture))
    checkpoint = metrics = None
    if config.iterations == 0:
        gains[fitted] = photometry.gains
        gaussians = gaussians_from_depth(
            frames, photometry, config.max_gaussians, config.contrast, optimized=False
        )
        how = "depth back-projected"
    else:
        views = ReconstructionViews(frames, photometry)
        test_views = None
        if held_out:
            unknown = Photometry(np.ones(len(held_out)), photometry.vignetting)
            test_views = ReconstructionViews(ShrunkFrames(capture, held_out, factor), unknown)
        checkpoint = Checkpoint(out, config, views)
        if restart:
            checkpoint.remove()
        optimization = Optimization(
            config,
            views,
            test_views,
            background,
            lambda extent: make_initial_gaussians(capture, frames, photometry, extent, config),
            checkpoint,
            Lpips() if config.lpips_weight > 0 else None,
            fit_gains=not capture.has_depth,
        )
        optimization.run()
        gains[fitted] = optimization.gains
        gains[held_out] = predict_gains(fitted, gains[fitted], held_out)
        gaussians = optimization.splats.scene(flat=config.representation == "2dgs")
        metrics = optimization.measure()
        how = f"{config.representation}, {config.iterations} steps"

    field, depth = make_distance_field(capture, frames, gaussians, config)
    images = depth.images("counting observations")
    # In voxels twice as large as those of the field.
    observations = Observations.from_depth_images(
        images, depth.K, depth.X_WCs, 2.0 * field.voxel_size
    )
    frontier = None
    if capture.metric:
        images = depth.images("finding unobserved space")
        field, frontier = close_frontier(field, images, depth.K, depth.X_WCs)
    ends = capture.X_WCs[0].translation(), capture.X_WCs[-1].translation()
    world = World(
        capture.name, gaussians, field, field, background, *ends, observations=observations
    )
    world, route, warnings = with_default_route(world, frontier, capture.metric)
    metadata = write_scene_folder(
        out,
        world,
        frontier,
        provenance=f"{capture.source}, {len(capture)} frames, {how}",
        gains=gains,
        vignetting=photometry.vignetting,
        metric=capture.metric,
        representation=config.representation if config.iterations else "3dgs",
        capture=capture.folder,
        capture_settings=capture.config.settings(),
        capture_notes=capture.notes,
        origin=capture.origin,
        held_out=held_out,
        image_width=capture.width // factor if factor > 1 else 0,
        split=split,
        source_digest=source,
    )
    write_text(out / SETTINGS, dump_config(config))
    if checkpoint is not None:
        checkpoint.remove()
    warnings = (*capture.dropped, *without_depth, *warnings)
    voxel_size = field.voxel_size
    return ReconstructSummary(out, metadata, len(gaussians), voxel_size, route, metrics, warnings)


def _digested(capture: Capture, digests: set[str]) -> Capture:
    """Returns the capture, whose loaded images add digests of their pixels to `digests`."""

    def load_image(i: int) -> NDArray[np.uint8]:
        image = capture.load_image(i)
        digests.update(part_digests([image.tobytes()]))
        return image

    return replace(capture, load_image=load_image)


def _source_and_split(capture: Capture, images: set[str], split: str) -> tuple[list[str], str]:
    """Returns the source digest of a scene and its split: of the world that was rendered, or else
    of the fitted `images`, by digest. `split` is the user's, or empty."""
    name = capture.folder or capture.name
    folder, rendered = Path(capture.folder), None
    if capture.folder:  # a rendered capture may hold others
        rendered = rendered_world(folder) or rendered_world(folder.parent)
    if rendered is None:
        digests, found = images, "train"
    elif rendered.source_digest:
        digests, found = set(rendered.source_digest), rendered.split
    else:
        raise ValueError(f"{name}/{RECIPE} has no source_digest; render the capture again")
    return source_digest(digests), choose_split(name, digests, split, found)


def _without_depth(
    capture: Capture, numbers: Sequence[int], frames: Sequence[ThinnedFrame]
) -> tuple[str, ...]:
    empty = [i for i, frame in zip(numbers, frames, strict=True) if not frame.depth.any()]
    if not capture.has_depth or not empty:
        return ()
    names = [capture.frame_names[i] if capture.frame_names else f"frame {i}" for i in empty]
    listed = ", ".join(names[:_MAX_NAMED]) + (", ..." if len(names) > _MAX_NAMED else "")
    return (f"{len(empty)} of {len(frames)} frames have no pixel with depth: {listed}",)


def with_default_route(
    world: World, frontier: GaussianScene | None, metric: bool
) -> tuple[World, ObservedRoute, tuple[str, ...]]:
    """Returns the world with its table of views and its default start and goal, this route, and
    warnings; the world as it is if it cannot be flown in."""
    route = ObservedRoute(world.p_WS, world.p_WG, float("nan"), float("nan"))
    if not metric:
        return world, route, ("this scene cannot be flown in: its scale is unknown",)
    shown = world
    if frontier is not None:
        gaussians = world.gaussians.merged_with(frontier)
        shown = replace(world, gaussians=gaussians, num_frontier=len(frontier))
    try:
        if shown.observations is None:
            ends = choose_start_and_goal(shown.esdf)
            route = ObservedRoute(*ends, float("nan"))
        else:
            shown = with_views(shown)
            route = choose_default_route(shown)
    except InfeasibleFlightError as error:
        return world, route, (f"this scene cannot be flown in: {error}",)
    warnings = [short_route_warning(route.length)]
    if route.unobserved > MAX_UNOBSERVED:
        warnings.append(
            f"a camera along the default route sees {route.unobserved:.0%} of unobserved pixels, "
            f"and more than {MAX_UNOBSERVED:.0%} along every other route of this length that was "
            "tried: capture more of the scene, in the directions of flight"
        )
    world = replace(world, p_WS=route.p_WS, p_WG=route.p_WG, observations=shown.observations)
    return world, route, tuple(warning for warning in warnings if warning)
