"""How a capture becomes a scene."""

from dataclasses import dataclass, field

import numpy as np

from splatpilot.diagrams.worlds.scene_folder import REPRESENTATIONS
from splatpilot.diagrams.worlds.splits import SPLITS
from splatpilot.systems.common.processes import available_cores
from splatpilot.systems.common.seeds import check_seed
from splatpilot.training.captures.capture_config import CaptureConfig

INITIALIZATIONS = ("auto", "depth", "points", "random")
STRATEGIES = ("auto", "none", "default", "mcmc")
DISTANCE_FIELDS = ("rendered", "captured")
DEVICES = ("cpu", "cuda")
HOLD_OUT = 8
"""Every so many frames one is held out, unless said otherwise."""
# [m]
_FINEST = 0.005


@dataclass(kw_only=True)
class ReconstructConfig:
    """How a capture becomes a scene. The defaults suit a room or a corridor of some 100 frames."""

    capture: CaptureConfig = field(default_factory=CaptureConfig)
    """What the capture's files leave open."""
    iterations: int = -1
    """Steps of optimisation, an image each; 0 takes depth and colours as they are. -1 takes as many
    as the capture needs: 32 for each image that is fitted, at least 2000 and at most 7000, where
    Gaussians start from depth; 7000 elsewhere."""
    representation: str = "3dgs"
    """What is optimised: "3dgs", Gaussians, or "2dgs", flat ones (Huang et al. 2024)."""
    initialization: str = "auto"
    """Where Gaussians start: on the surfaces that "depth" shows, on the "points" of structure from
    motion, or at "random" in what the cameras see; "auto" takes the first that the capture has."""
    initial_gaussians: int = 120_000
    """At most as many are there at first."""
    max_gaussians: int = 180_000
    """At most as many are there at last. Without iterations, texture is resolved as finely as they
    allow."""
    split: str = ""
    """What the scene is for: "train", "validation" or "test". Empty: what the capture says, or
    "train". What the benchmark tests in is always "test"."""
    image_width: int = 320
    """[px] that images are shrunk to, as nearly as a whole factor can; 0 keeps their size, and so
    do 0 iterations."""
    hold_out: int = -1
    """Every so many frames one, the first included, is held out from all that fits, and measures
    the scene; 0 holds out none, and so do 0 iterations. -1 holds out those that the files of the
    capture hold out or, where they do not say, every eighth."""

    depth_weight: float = 0.2
    """lambda_d, the weight of the depth term; 0 looks at colours alone."""
    depth_mode: str = "ED"
    """The depth it compares: "ED", expected, or "D", accumulated, the paper's equation 2."""
    surface_weight: float = 1.5
    """Of the distance of each Gaussian from the surface that it is part of, see `surface_loss`."""
    outline_weight: float = 1.0
    """Of the outlines of things before the infinitely far, see `outline_loss`: every other step of
    a view that has some fits them in place of colours. 0 for none."""
    ssim_weight: float = 0.2
    """Of structural similarity in the photometric loss; that of L1 is the rest."""
    lpips_weight: float = 0.0
    """Of the perceptual term late in training."""
    lpips_fraction: float = 0.1
    """The last part of the steps, which have the perceptual term."""
    lpips_every: int = 4
    """One of so many of these steps has it, as many times as heavy: it costs more than the rest."""
    distortion_weight: float = 0.01
    """2dgs: of the spread of the surfels along each ray, after a tenth of the steps."""
    normal_weight: float = 0.05
    """2dgs: of the angle between surfels and the surface they make, after a quarter of the
    steps."""
    sh_degree: int = 0
    """Of the spherical harmonics; 0 gives the same colour in all directions."""

    strategy: str = "auto"
    """How Gaussians are added and removed: "none", "default" (Kerbl et al. 2023) or "mcmc"
    (Kheradmand et al. 2024); "auto" is "none" where they start from depth, which puts some on every
    surface, and "default" elsewhere."""
    refine_start: int = 500
    """Step of the first change."""
    refine_every: int = 100
    """Steps from one change to the next."""
    refine_fraction: float = 0.5
    """Part of all steps after which there are no more."""
    reset_every: int = 3000
    """default: steps between resets of all opacities, while there are changes; 0 for never."""
    grow_gradient: float = 2e-4
    """default: mean gradient of a Gaussian's place on the image, in half widths of it, above which
    it is doubled or split."""
    prune_opacity: float = 0.005
    """Gaussians fainter than this are removed, or by mcmc moved to others."""
    noise: float = 5e5
    """mcmc: strength of the random walk, relative to the learning rate of the means."""

    means_rate: float = 1.6e-4
    """Learning rate of the means relative to the extent of the scene; falls to a hundredth. These
    rates are for Gaussians that start anywhere; those that start on surfaces that depth shows have
    others by fixed factors, see `learning_rates`."""
    scales_rate: float = 5e-3
    """Learning rate of the logarithms of the scales."""
    quats_rate: float = 1e-3
    """Learning rate of the quaternions."""
    opacities_rate: float = 5e-2
    """Learning rate of the logits of the opacities."""
    colors_rate: float = 2.5e-3
    """Learning rate of the colours of degree 0; of higher ones a twentieth."""

    contrast: float = 0.03
    """Standard deviation of colour (0 to 1) that one Gaussian may hide at first."""
    max_cell: int = 16
    """[px] of the image that one Gaussian of the surface may cover; a power of two."""
    max_extent: float = 0.06
    """Length on the surface that one Gaussian of it may cover, as a fraction of its distance from
    the camera: seen from closer by, large ones are drawn badly."""
    opacity: float = 0.99
    """Opacity of every Gaussian if there are no iterations, in (0, 1]."""

    distance_field: str = "rendered"
    """Which depth becomes the distance field: "rendered" from the Gaussians, or "captured".
    Captures without depth have only the former; without iterations there is only the latter."""
    voxel_size: float = 0.0
    """[m], of the distance field. Where the scale is unknown, the median depth counts as 2 m. 0 for
    0.05, or as coarse as makes 20 million voxels of a large place."""
    max_range: float = 0.0
    """[m], depth beyond which the distance field does not believe the camera; the same applies. 0
    for 8, or half as much again as the median depth where that is more."""

    seed: int = 0
    """Seed of everything random."""
    device: str = "cpu"
    """"cpu", or "cuda", which needs gsplat."""
    threads: int = 0
    """CPU threads of the renderer, which do not change the result; 0 for all cores."""
    checkpoint_every: int = 1000
    """Steps between checkpoints, from which an interrupted run goes on."""
    measure_every: int = 1000
    """Steps between measurements on the withheld frames."""
    tensorboard: str = ""
    """Folder for these measurements in the format of tensorboard, which must be installed; empty
    for none."""

    @property
    def renderer_threads(self) -> int:
        return self.threads or available_cores()

    def validate(self) -> None:
        """Raises ValueError for values that make no sense."""
        check_seed(self.seed)
        choices = {
            "representation": REPRESENTATIONS,
            "initialization": INITIALIZATIONS,
            "strategy": STRATEGIES,
            "distance_field": DISTANCE_FIELDS,
            "split": ("", *SPLITS),
            "device": DEVICES,
            "depth_mode": ("D", "ED"),
        }
        for name, allowed in choices.items():
            if getattr(self, name) not in allowed:
                raise ValueError(
                    f"{name} is {getattr(self, name)!r}; choose {' or '.join(allowed)}"
                )
        least = {
            "iterations": -1,
            "initial_gaussians": 1,
            "max_gaussians": 1,
            "image_width": 0,
            "hold_out": -1,
            "depth_weight": 0,
            "surface_weight": 0,
            "outline_weight": 0,
            "lpips_weight": 0,
            "lpips_every": 1,
            "distortion_weight": 0,
            "normal_weight": 0,
            "refine_start": 0,
            "refine_every": 1,
            "reset_every": 0,
            "grow_gradient": 0,
            "noise": 0,
            "means_rate": 0,
            "scales_rate": 0,
            "quats_rate": 0,
            "opacities_rate": 0,
            "colors_rate": 0,
            "contrast": 0.001,
            "max_extent": 0.001,
            "voxel_size": 0,
            "max_range": 0,
            "seed": 0,
            "threads": 0,
            "checkpoint_every": 1,
            "measure_every": 1,
        }
        for name, limit in least.items():
            if not limit <= getattr(self, name) < np.inf:
                raise ValueError(
                    f"{name} is {getattr(self, name)}, at least {limit} and finite is needed"
                )
        for name in ("ssim_weight", "lpips_fraction", "refine_fraction"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} is {getattr(self, name)}, it must be in [0, 1]")
        for name in ("opacity", "prune_opacity"):
            if not 0 < getattr(self, name) <= 1:
                raise ValueError(f"{name} is {getattr(self, name)}, it must be in (0, 1]")
        if self.max_cell not in (1, 2, 4, 8, 16, 32, 64):
            raise ValueError(f"max_cell is {self.max_cell}, a power of two up to 64 is needed")
        if self.sh_degree not in (0, 1, 2, 3):
            raise ValueError(f"sh_degree is {self.sh_degree}, 0 to 3 is needed")
        if self.hold_out == 1:
            raise ValueError("hold_out is 1, which withholds every frame; use 0 or at least 2")
        if 0 < self.voxel_size < _FINEST:
            raise ValueError(
                f"voxel_size is {self.voxel_size} m; at least {_FINEST}, or 0 for what suits the "
                "place, is needed"
            )
        if 0 < self.max_range <= self.voxel_size:
            raise ValueError(
                f"max_range is {self.max_range} m, more than the voxel size {self.voxel_size} m is "
                "needed"
            )
        if self.representation == "2dgs" and self.strategy == "mcmc":
            raise ValueError(
                "representation is 2dgs and strategy mcmc, whose relocation is for Gaussians; use "
                "none or default"
            )
