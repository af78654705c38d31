"""How a student is trained."""

from dataclasses import dataclass, field
from typing import ClassVar

from splatpilot.systems.common.seeds import check_seed
from splatpilot.systems.sensing.noise import ObservationNoise
from splatpilot.training.policies.image_noise import validate_training_noise
from splatpilot.training.policies.student_images import Appearance
from splatpilot.training.policies.student_network import IMAGE_MODULES
from splatpilot.training.policies.trainer import Schedule


@dataclass
class StudentTraining:
    """A training run."""

    observation: ClassVar[str]
    """What the student sees: rgb or depth."""

    # Seed of everything random, 0 to 2147483647.
    seed: int = 0
    # Where the tensors live: cpu, or cuda.
    device: str = "cpu"
    # Folders of what is learned from, as `splatpilot corpus make` writes them.
    corpora: list[str] = field(default_factory=lambda: ["out/corpus"])
    # [-] Part of the corpora's worlds, by name, that choose among checkpoints instead.
    held_out: float = 0.1
    # [-] Worlds that are trained in, of those that are left; all of them where 0.
    worlds: int = 0
    # [-] Held-out samples that are looked at, evenly spaced.
    validation_samples: int = 2000
    schedule: Schedule = field(
        default_factory=lambda: Schedule(
            updates=4000, validate_every=1000, checkpoint_every=500, learning_rate=5e-4, decay=0.5
        )
    )
    # Whether the encoder begins with what it learned from ImageNet, or from nothing.
    pretrained: bool = True
    # File of this policy's weights, which are trained further instead; a head of another shape
    # begins anew. None where left empty.
    begin: str = ""
    # File of ImageNet's; where left empty, that of the data folder or torchvision's download.
    encoder: str = ""
    # [-] Width of the layer before the linear one that the hypotheses are of; none, as published,
    # where 0.
    head_features: int = 256
    # [-] First modules that keep their weights: of the 19 of the encoder, and the layer of its
    # cells as the 20th. What they make of images is computed once. These 7 see edges, at an eighth
    # of the image's size, which depth has too; what 18 see in photographs is not what keeps clear
    # of things. With 20 of a student that was trained already (`begin`), the head alone learns on,
    # a hundred times as fast: it needs many more samples than the encoder.
    frozen: int = 7
    # [-] Draws of light and noise that are kept of each image, where modules are frozen; a new one
    # for each step where none are.
    draws: int = 1
    # Folder that they are kept in, for other runs too.
    features: str = "out/features"
    # [-] Samples a step of the optimiser.
    batch: int = 32
    # [-] Part of each step's samples that are of recovery: states that a student came to. As many
    # as there are, few beside the expert's, where it is 0; without effect where there are none.
    recovery_share: float = 0.0
    # [-] Trajectories of a sample that vote, the cheapest first, K; all, as published, where 0. The
    # others are slower and higher in the mean than what the expert flies, and so is a
    # student that takes them for as good.
    experts: int = 1
    # [-] Times that the errors of all hypotheses but the first count where they contend for votes:
    # at 10 another gets an expert's only where the first is over three times as far off. All are
    # equal, as published, at 1. More flights arrive by colours at 10 with an epsilon of 0, and
    # fewer by depth; it takes a head that began with equal ones (`begin`), as of a new one all
    # but the first would never get a vote.
    handicap: float = 1.0
    # [-] Part of an expert's pull that hypotheses without votes share; more of it makes all
    # hypotheses alike, none lets those that begin badly never be used.
    epsilon: float = 0.05
    # [1/(m s)] What a metre of soft barrier for a second adds to an error in square metres: at 1
    # grazing an obstacle all along costs as much as flying half a metre beside the expert.
    geometric_weight: float = 1.0
    # [-] Weight of the cost head's error beside the imitation: costs are about 1 where errors are
    # tenths of a square metre, and would rule the encoder at 1.
    cost_weight: float = 0.1
    # [-] Weight of the clearance that hypotheses lack of their expert's, squared as errors are;
    # none, as published, where 0. To errors a decimetre towards a wall is as bad as one along it.
    clearance_weight: float = 0.0
    # [m] From surfaces to the vehicle's centre; of an expert that is farther off, as much is asked.
    clearance_cap: float = 0.8
    # Whether half of the images are seen in a mirror, as is what is told and asked of them.
    mirrored: bool = False
    # How far images are relit; a corpus has looks of its own.
    appearance: Appearance = field(default_factory=lambda: Appearance(exposure=0.0, hue=0.0))
    # What the images are disturbed by. Where modules are frozen it costs more than it gains: their
    # features of grain and of pixels without depth are unlike those of anything else.
    noise: ObservationNoise = field(default_factory=ObservationNoise)
    # Part of the images that are relit and disturbed; the others are seen as they are.
    disturbed: float = 1.0

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        check_seed(self.seed)
        self.schedule.validate()
        if not self.corpora:
            raise ValueError("corpora is empty; name one or more folders of corpora")
        for name in ("worlds", "experts"):
            if getattr(self, name) < 0:
                raise ValueError(
                    f"{name} is {getattr(self, name)}; it must be at least 0, which is all"
                )
        for name, limit in (
            ("held_out", 0.9),
            ("epsilon", 0.5),
            ("recovery_share", 1.0),
            ("disturbed", 1.0),
        ):
            value = getattr(self, name)
            if not 0.0 <= value <= limit:
                raise ValueError(f"{name} is {value}; it must be 0 to {limit}")
        if not 1.0 <= self.handicap < float("inf"):
            raise ValueError(
                f"handicap is {self.handicap}; it must be at least 1, at which all hypotheses are "
                "equal"
            )
        for name in ("batch", "draws", "validation_samples"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be at least 1")
        for name in ("geometric_weight", "cost_weight", "clearance_weight", "clearance_cap"):
            if not 0.0 <= getattr(self, name) < float("inf"):
                raise ValueError(f"{name} is {getattr(self, name)}; it must be at least 0")
        if not 0 <= self.frozen <= IMAGE_MODULES:
            raise ValueError(f"frozen is {self.frozen}; there are 0 to {IMAGE_MODULES} modules")
        if self.frozen == IMAGE_MODULES and not self.begin:
            raise ValueError(
                f"frozen is {self.frozen}, but the layer of the cells was not trained yet; set "
                f"begin to a file of weights, or frozen to at most {IMAGE_MODULES - 1}"
            )
        if self.frozen and not (self.pretrained or self.begin):
            raise ValueError(
                f"frozen is {self.frozen}, but what was not trained yet cannot stay as it is; set "
                "pretrained=true or frozen=0"
            )
        sees_depth = self.observation == "depth"
        validate_training_noise(
            self.noise, "noise", of_depth=sees_depth, of_colors=not sees_depth, of_time=False
        )
        self.appearance.validate("appearance")
        if sees_depth and self.appearance != Appearance(0.0, 0.0):
            raise ValueError(
                f"appearance must be left out, got {self.appearance}: depth has no appearance"
            )


@dataclass
class StudentRgbTraining(StudentTraining):
    """Of a student that sees colours."""

    observation = "rgb"


@dataclass
class StudentDepthTraining(StudentTraining):
    """Of a student that sees depth."""

    observation = "depth"

    # By colours it was tried, and gained nothing.
    clearance_weight: float = 5.0
