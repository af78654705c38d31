"""Options of a reconstruction."""

from dataclasses import dataclass, field

from splatpilot.systems.common.processes import available_cores
from splatpilot.systems.common.validation import Config, bounded, check_seed, require_field
from splatpilot.training.captures.capture_config import CaptureConfig

HOLD_OUT = 8
"""Default interval of held-out frames."""
_MIN_VOXEL_SIZE = 0.005  # [m]


@dataclass(kw_only=True)
class ReconstructConfig(Config):
    """Settings of a reconstruction; the defaults suit a room or a corridor of some 100 frames."""

    capture: CaptureConfig = field(default_factory=CaptureConfig)
    """Settings that the capture's files do not have."""
    iterations: int = bounded(-1, "[-1, inf)")
    """Optimization steps, one image each; 0 takes depth and colors as they are. -1 takes 32 for
    each fitted image, in [2000, 7000], if Gaussians start from depth, and 7000 otherwise."""
    representation: str = bounded("3dgs", "{3dgs, 2dgs}")
    """"3dgs", Gaussians, or "2dgs", flat Gaussians (Huang et al. 2024)."""
    initialization: str = bounded("auto", "{auto, depth, points, random}")
    """Initial positions: surfaces from "depth", "points" of structure from motion, which are
    triangulated between the images of a capture without any, or "random" in the cameras' views;
    "auto" takes depth or, without it, points."""
    initial_gaussians: int = bounded(0, "[0, inf)")
    """Maximum number of initial Gaussians, at most `max_gaussians`. 0 takes as many as shape and
    texture need at the resolution of the closest images, if they start from depth, or as there are
    points, or 120,000 if they start at random."""
    max_gaussians: int = bounded(0, "[0, inf)")
    """Maximum number of Gaussians. 0 is 1,000,000, or `initial_gaussians` if more, if they start
    from depth and none are added, else 180,000. Without iterations, it sets how finely texture is
    resolved."""
    split: str = bounded("", "{, train, validation, test}")
    """Use of the scene; empty takes the capture's, or "train". Scenes of the benchmark are "test".
    """
    image_width: int = bounded(320, "[0, inf) px")
    """[px], to which images are shrunk, by the closest integer factor. 0 keeps their size, as do 0
    iterations."""
    hold_out: int = bounded(-1, "[-1, inf)")
    """Interval of frames, from the first, that are not fitted but measure the scene. 0 holds out no
    frame, as do 0 iterations. -1 takes those that the capture's files hold out, or every eighth.
    """

    depth_weight: float = bounded(0.2, "[0, inf)")
    """lambda_d, weight of the depth term; 0 fits only colors."""
    depth_mode: str = bounded("ED", "{D, ED}")
    """Depth in this term: "ED", expected, or "D", accumulated, the paper's equation 2."""
    surface_weight: float = bounded(1.5, "[0, inf)")
    """Weight of the distance between Gaussians and their surface, see `surface_loss`."""
    outline_weight: float = bounded(1.0, "[0, inf)")
    """Weight of the outlines of objects before the sky, see `outline_loss`. Up to
    half of the steps of a view, the more sky it has the more, fit them instead of colors."""
    lpips_weight: float = bounded(0.0, "[0, inf)")
    """Weight of LPIPS in the last tenth of the steps."""
    sh_degree: int = bounded(0, "[0, 3]")
    """Degree of the spherical harmonics; 0 gives one color in all directions."""

    strategy: str = bounded("auto", "{auto, none, default}")
    """Densification: "none", or "default" (Kerbl et al. 2023); "auto" is "none" if Gaussians start
    from depth, and "default" otherwise."""
    refine_start: int = bounded(500, "[0, inf)")
    """Step of the first change."""
    refine_every: int = bounded(100, "[1, inf)")
    """Steps between changes."""
    refine_fraction: float = bounded(0.5, "[0, 1]")
    """Fraction of all steps after which there are no more changes."""
    reset_every: int = bounded(3000, "[0, inf)")
    """Steps between resets of all opacities, while there are changes; 0 never resets them."""
    means_rate: float = bounded(1.6e-4, "[0, inf)")
    """Learning rate of the means, which falls to a hundredth, relative to the median depth if
    Gaussians start from depth, or else to the extent of the cameras."""

    contrast: float = bounded(0.03, "[0.001, inf)")
    """Standard deviation of color (0 to 1) that one initial Gaussian may average."""

    distance_field: str = bounded("rendered", "{rendered, captured}")
    """Depth that is fused: "rendered" from the Gaussians, the only one without captured depth, or
    "captured", the only one without iterations."""
    voxel_size: float = bounded(0.0, "[0, inf) m")
    """[m], of the distance field. If the scale is unknown, the median depth counts as 2 m. 0 for
    0.05, or coarser if that takes more than 20 million voxels."""
    max_range: float = bounded(0.0, "[0, inf) m")
    """[m], maximum depth in the distance field, in the same unit. 0 for the larger of 8 and 1.5
    times the median depth."""

    seed: int = 0
    """Seed of everything random."""
    device: str = bounded("cpu", "{cpu, cuda}")
    """"cpu", or "cuda", which needs gsplat."""
    threads: int = bounded(0, "[0, inf)")
    """CPU threads of the renderer, which do not change the result; 0 for all cores."""
    checkpoint_every: int = bounded(1000, "[1, inf)")
    """Steps between checkpoints, from which an interrupted run resumes."""
    tensorboard: str = ""
    """Folder for metrics in the format of tensorboard, which must be installed; empty for none."""

    @property
    def renderer_threads(self) -> int:
        return self.threads or available_cores()

    def check(self) -> None:
        check_seed(self.seed)
        require_field(self, "hold_out", self.hold_out != 1, "0 or at least 2")
        fine = self.voxel_size == 0 or self.voxel_size >= _MIN_VOXEL_SIZE
        require_field(self, "voxel_size", fine, f"0 or at least {_MIN_VOXEL_SIZE} m")
        far = self.max_range == 0 or self.max_range > self.voxel_size
        require_field(self, "max_range", far, f"above voxel_size {self.voxel_size} m")
