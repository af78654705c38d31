"""From a capture to a scene folder that can be flown in."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from flysplat.diagrams.worlds.scene_folder import check_scene_target, write_scene_folder
from flysplat.diagrams.worlds.start_and_goal import choose_start_and_goal
from flysplat.diagrams.worlds.world import World
from flysplat.systems.collision.distance_field import FieldState
from flysplat.systems.collision.esdf import Esdf
from flysplat.systems.collision.esdf_build import bounds_of_depth_images, esdf_from_depth_images
from flysplat.systems.splats.gaussian_scene import GaussianScene
from flysplat.systems.vehicle.quadrotor_dynamics import VEHICLE_RADIUS
from flysplat.training.captures.capture import Capture
from flysplat.training.captures.read_capture import read_capture
from flysplat.training.depth_gaussians import frame_gaussians, principal_axes
from flysplat.training.overlap import STRIDE, View, find_new_pixels, load_views
from flysplat.training.photometry import Photometry, estimate_photometry


@dataclass(kw_only=True)
class ReconstructConfig:
    """How a capture becomes a scene."""

    iterations: int = 0
    """Steps of optimisation; 0 takes depth and colours as they are."""
    max_gaussians: int = 180_000
    """More are never made: texture is resolved as finely as they allow."""
    contrast: float = 0.05
    """Standard deviation of colour (0 to 1) that one Gaussian may hide."""
    max_cell: int = 16
    """[px] of the image that one Gaussian of the surface may cover; a power of two."""
    max_extent: float = 0.06
    """Length on the surface that one Gaussian of it may cover, as a fraction of its distance from
    the camera: seen from closer by, large ones are drawn badly."""
    opacity: float = 0.99
    """Opacity of every Gaussian, in (0, 1]."""
    voxel_size: float = 0.05
    """[m], of the distance field."""
    max_range: float = 8.0
    """[m], depth beyond which the distance field does not believe the camera."""
    seed: int = 0
    """Of the sampling of pixels that are compared between frames."""

    def validate(self) -> None:
        """Raises ValueError for values that make no sense."""
        for name, limit in (
            ("max_gaussians", 1),
            ("contrast", 0.001),
            ("max_extent", 0.001),
            ("voxel_size", 0.005),
        ):
            if not limit <= getattr(self, name) < np.inf:
                raise ValueError(
                    f"{name} is {getattr(self, name)}, at least {limit} and finite is needed"
                )
        if self.seed < 0:
            raise ValueError(f"seed is {self.seed}, at least 0 is needed")
        if self.iterations != 0:
            raise ValueError(
                f"iterations is {self.iterations}: optimisation is not available yet, use 0"
            )
        if self.max_cell not in (1, 2, 4, 8, 16, 32, 64):
            raise ValueError(f"max_cell is {self.max_cell}, a power of two up to 64 is needed")
        if not 0 < self.opacity <= 1:
            raise ValueError(f"opacity is {self.opacity}, it must be in (0, 1]")
        if not self.max_range > self.voxel_size:
            raise ValueError(
                f"max_range is {self.max_range} m, more than the voxel size {self.voxel_size} m is "
                "needed"
            )


@dataclass(frozen=True)
class ReconstructSummary:
    """What was made."""

    scene: Path
    frames: int
    gaussians: int
    vignetting: float
    gain_range: tuple[float, float]
    lower_W: NDArray[np.float64]  # (3,) [m]
    upper_W: NDArray[np.float64]  # (3,) [m]
    observed_free_volume: float  # [m^3]
    p_WS: NDArray[np.float64]  # (3,) [m]
    p_WG: NDArray[np.float64]  # (3,) [m]
    geodesic: float  # [m], length of the shortest path from start to goal

    def __str__(self) -> str:
        def vector(p: NDArray) -> str:
            return "(" + ", ".join(f"{x:.2f}" for x in p) + ")"

        rows = {
            "scene": self.scene,
            "frames": self.frames,
            "Gaussians": self.gaussians,
            "bounds [m]": f"{vector(self.lower_W)} to {vector(self.upper_W)}",
            "seen free [m^3]": f"{self.observed_free_volume:.1f}",
            "image gains": f"{self.gain_range[0]:.3f} to {self.gain_range[1]:.3f}",
            "corner brightness": f"{np.exp(self.vignetting):.3f}",
            "default start [m]": vector(self.p_WS),
            "default goal [m]": vector(self.p_WG),
            "shortest path [m]": f"{self.geodesic:.1f}",
        }
        return "\n".join(f"{name:<18} {value}" for name, value in rows.items())


def run(*, capture: str | Path, out: str | Path, config: ReconstructConfig) -> ReconstructSummary:
    """Turns the capture in a folder into the scene folder `out`, and prints a summary.

    Raises:
        FileNotFoundError, ValueError, OSError: for a damaged capture, a config that makes no sense,
            a folder `out` that cannot be written or holds something else, or a capture that saw no
            space large enough for the vehicle. Nothing is written then.
    """
    config.validate()
    check_scene_target(out)
    summary = reconstruct(read_capture(capture), Path(out), config)
    print(summary)
    return summary


def reconstruct(capture: Capture, out: Path, config: ReconstructConfig) -> ReconstructSummary:
    """Writes the scene folder `out`; see `run`."""
    views = list(tqdm(load_views(capture), "loading", len(capture), unit="frame"))
    photometry = estimate_photometry(views, config.seed)
    esdf = _distance_field(capture, config)
    p_WS, p_WG, geodesic = choose_start_and_goal(esdf, VEHICLE_RADIUS)
    gaussians, background = _gaussians(capture, views, photometry, config)
    world = World(capture.name, gaussians, esdf, esdf, background, p_WS, p_WG)
    write_scene_folder(
        out,
        world,
        provenance=f"{capture.source}, {len(capture)} frames, depth back-projected",
        gains=[float(gain) for gain in photometry.gains],
        vignetting=photometry.vignetting,
    )
    return ReconstructSummary(
        scene=out,
        frames=len(capture),
        gaussians=len(gaussians),
        vignetting=photometry.vignetting,
        gain_range=(float(photometry.gains.min()), float(photometry.gains.max())),
        lower_W=esdf.lower_W,
        upper_W=esdf.upper_W,
        observed_free_volume=esdf.volume(FieldState.FREE),
        p_WS=p_WS,
        p_WG=p_WG,
        geodesic=geodesic,
    )


def _distance_field(capture: Capture, config: ReconstructConfig) -> Esdf:
    """Fuses the depth images; space that no image saw is marked unknown."""

    def depths() -> Iterator[NDArray[np.float32]]:
        return (capture.registered_depth(i) for i in range(len(capture)))

    lower_W, upper_W = bounds_of_depth_images(depths(), capture.K, capture.X_WCs, config.max_range)
    return esdf_from_depth_images(
        depths(),
        capture.K,
        capture.X_WCs,
        lower_W,
        upper_W,
        config.voxel_size,
        config.max_range,
    )


def _gaussians(
    capture: Capture, views: Sequence[View], photometry: Photometry, config: ReconstructConfig
) -> tuple[GaussianScene, tuple[float, float, float]]:
    """Returns the Gaussians of all frames, each point once, and their mean colour."""
    # A gain is a rough account of another tone curve, so other images are preferred to odd ones.
    odd = np.flatnonzero(np.abs(np.log(photometry.gains / np.median(photometry.gains))) > 0.05)
    new = find_new_pixels(views, last=odd.tolist())

    def gaussians_of(i: int) -> tuple[NDArray, NDArray, NDArray]:
        frame = capture.frame(i)
        height, width = frame.depth.shape
        factor = photometry.factor(i, height, width)
        image = (frame.image / (255 * factor[..., None])).astype(np.float32)
        wanted = new[i].repeat(STRIDE, axis=0).repeat(STRIDE, axis=1)[:height, :width]
        return frame_gaussians(frame, image, wanted, contrast, max_cell, max_extent)

    # Fewer, coarser cells until the Gaussians fit: first where texture asks for fine ones, then
    # everywhere.
    contrast, max_cell, max_extent = config.contrast, config.max_cell, config.max_extent
    while True:
        progress = tqdm(range(len(capture)), f"Gaussians, contrast {contrast:.2f}", unit="frame")
        parts = [gaussians_of(i) for i in progress]
        if sum(len(p_WQ) for p_WQ, _, _ in parts) <= config.max_gaussians:
            break
        if contrast < 1:
            contrast *= 1.3
        elif max_cell < 64:
            max_cell, max_extent = 2 * max_cell, 2 * max_extent
        else:
            raise ValueError(
                f"max_gaussians is {config.max_gaussians}: too few for {len(capture)} frames, even "
                f"with cells of {max_cell} pixels; allow more, or use fewer frames"
            )
    p_WQ, covariances, colors = (np.concatenate(column) for column in zip(*parts, strict=True))
    quats, scales = principal_axes(covariances)
    opacities = np.full(len(p_WQ), config.opacity)
    red, green, blue = np.clip(colors.mean(axis=0), 0, 1)
    scene = GaussianScene.from_colors(p_WQ, quats, scales, opacities, colors)
    return scene, (float(red), float(green), float(blue))
