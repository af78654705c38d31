"""What the configurations of learned depth policies have in common."""

from dataclasses import dataclass, field
from typing import ClassVar, Protocol

from splatpilot.systems.common.validation import require_field
from splatpilot.systems.policies.agile_autonomy_inference import TrajectoryNetworkSpec
from splatpilot.systems.policies.observations import require_poolable
from splatpilot.systems.policies.recurrent_network import NetworkSpec
from splatpilot.systems.sensing.onboard_camera import OnboardCamera


@dataclass
class DepthPolicyConfig:
    """The policy's weights, and what it is asked for."""

    network: ClassVar[NetworkSpec | TrajectoryNetworkSpec]
    """Architecture of the policy."""
    rate: ClassVar[float]
    """[Hz], that the policy was trained at."""

    # [m/s] Speed that it is asked to fly at; the model card of its weights says what they know.
    speed: float = 2.0
    # File of weights, as `splatpilot train` writes them; those that ship where left empty.
    weights: str = ""
    # What it sees through: its pixels are pooled to the network's, so give multiples of these.
    camera: OnboardCamera = field(default_factory=OnboardCamera)

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        require_speed(self)
        self.camera.validate()
        require_poolable(
            self.camera.height,
            self.camera.width,
            self.network.image_height,
            self.network.image_width,
        )


class _HasSpeed(Protocol):
    speed: float


def require_speed(config: _HasSpeed) -> None:
    """Raises ValueError unless the speed that a policy is asked for can be."""
    require_field(config, "speed", 0.1 <= config.speed <= 10.0, "in [0.1, 10] m/s")
