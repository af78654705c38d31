"""How a corpus is gathered."""

from dataclasses import dataclass, field

from splatpilot.systems.seeds import first_training_seed
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.training.corpus.library import LibraryConfig
from splatpilot.training.corpus.perturbation import PerturbationConfig
from splatpilot.training.corpus.sample import SampleSize
from splatpilot.training.policies.expert import ExpertConfig


@dataclass
class CorpusConfig:
    """Everything that decides what is gathered, but in how many worlds."""

    # Seed of everything random, 0 to 999.
    seed: int = 0
    worlds: LibraryConfig = field(default_factory=LibraryConfig)
    expert: ExpertConfig = field(default_factory=ExpertConfig)
    # [-] Flights of the expert in each world, all to its goal: the first from its start, the others
    # from anywhere at least half as far away.
    flights: int = 16
    # [-] States in each world that lie on no flight: anywhere in free space, half of them before a
    # surface; see `training/corpus/off_path.py`.
    off_path: int = 0
    # What the student will see through.
    camera: OnboardCamera = field(default_factory=lambda: OnboardCamera(width=160, height=120))
    perturbation: PerturbationConfig = field(default_factory=PerturbationConfig)
    # [-] How much the look of a world changes from flight to flight: 0 not at all, 1 all it may.
    appearance: float = 1.0

    def validate(self) -> None:
        """
        Raises:
            FileNotFoundError: for a scene that is not there.
            ValueError: on a value out of range, naming it, its limit and the remedy.
        """
        first_training_seed(self.seed)
        self.worlds.validate()
        self.expert.validate()
        if not 1 <= self.flights <= 1000:
            raise ValueError(f"flights is {self.flights}; it must be 1 to 1000")
        if not 0 <= self.off_path <= 100_000:
            raise ValueError(f"off_path is {self.off_path}; it must be 0 to 100000")
        self.camera.validate()
        self.perturbation.validate()
        if not 0.0 <= self.appearance <= 1.0:
            raise ValueError(f"appearance is {self.appearance}; it must be 0 to 1")

    @property
    def size(self) -> SampleSize:
        """Of the samples."""
        return SampleSize(self.camera.height, self.camera.width, self.expert.num_hypotheses)
