"""Times how fast the student learns and plans, on one core.

    OMP_NUM_THREADS=1 python benchmarks/student.py [CORPUS]

Samples per second, with and without frozen modules, need a corpus. Times are CPU time, the minimum
of a few repeats.
"""

import sys
import tempfile

import cv2
import numpy as np
import torch
from harness import seconds

from splatpilot.systems.policies.base import Observation
from splatpilot.systems.policies.student import StudentNetwork, StudentSpec, plan
from splatpilot.systems.vehicle.quadrotor import hover_state
from splatpilot.systems.vehicle.state import QuadrotorState, pose_from_state
from splatpilot.training.policies.student_network import StudentModule
from splatpilot.training.policies.train import step_optimizer
from splatpilot.training.policies.train_student import StudentDepthTraining, StudentTrainer


def tick_time(observation: str, width: int, height: int) -> float:
    """Times planning [s], from the camera's image to the hypotheses."""
    spec, rng = StudentSpec(observation, width, height), np.random.default_rng(0)
    weights = {name: w.numpy() for name, w in StudentModule(spec).state_dict().items()}
    network = StudentNetwork(spec, weights)
    color = rng.integers(0, 256, (height, width, 3)).astype(np.uint8)
    image = color if observation == "rgb" else rng.uniform(0.5, 15.0, (height, width))
    x, p_WG = hover_state([0, 0, 2]), np.array([9.0, 0.0, 2.0])
    seen = Observation(0.0, pose_from_state(x), QuadrotorState.of(x), p_WG, image)
    return seconds(lambda: plan(network, seen), 30)


def samples_per_second(corpus: str, frozen: int, features: str) -> float:
    """Times training from depth with the optimizer, given the features of frozen modules."""
    config = StudentDepthTraining(corpora=[corpus], frozen=frozen, features=features)
    trainer = StudentTrainer(config)
    optimizer = torch.optim.AdamW(trainer.network.parameters())

    def learn() -> None:
        step_optimizer(trainer.losses, trainer.network, optimizer, 1.0)

    return config.batch / seconds(learn, 10)


def main() -> None:
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    for width, height in ((160, 120), (320, 240)):
        for observation in ("rgb", "depth"):
            spent = tick_time(observation, width, height)
            print(f"one tick at {width}x{height}, {observation}: {1e3 * spent:.1f} ms")
    for corpus in sys.argv[1:]:
        with tempfile.TemporaryDirectory() as features:
            for frozen in (0, 7, 18):
                rate = samples_per_second(corpus, frozen, features)
                print(f"{corpus}, {frozen} modules frozen: {rate:.0f} samples/s")


if __name__ == "__main__":
    main()
