"""The commands that are ended, each small enough to be run hundreds of times."""

import dataclasses
import shutil
from collections.abc import Callable
from pathlib import Path

from room import tiled_color, write_room_capture

_RECONSTRUCT = ("iterations=24", "image_width=0", "hold_out=6", "voxel_size=0.2", "threads=1")
_RECONSTRUCT = (*_RECONSTRUCT, "checkpoint_every=8", "initial_gaussians=1500", "lpips_weight=0")
_TRAIN = (
    *("worlds.kinds=[P10]", "worlds.count=1", "worlds.held_out=1", "worlds.voxel_size=0.5"),
    *("schedule.updates=6", "schedule.validate_every=3", "schedule.checkpoint_every=2"),
    *("validation.patience=0.3", "rollout.environments=4", "rollout.steps=4"),
)
_SHORT = (
    "world: {length: 8, width: 5, height: 3, rocks: 0, logs: 0, voxel_size: 0.25}\n"
    "camera: {width: 64, height: 48}\n"
    "timeout: 1.5\n"
)


@dataclasses.dataclass(frozen=True)
class Verb:
    """A command that leaves the folder `out`, and what must be the same however often it was
    ended."""

    words: Callable[[Path], list[str]]
    """Behind `splatpilot`, for a folder that holds what `prepare` makes."""
    same: str
    """Patterns of the files in `out` whose bytes must be equal, parted by spaces."""
    changed: str = ""
    """Patterns of what of `prepare` the command writes to, and must be equal too."""
    reads_scene: bool = False


def prepare(folder: Path) -> None:
    """Makes what the commands read."""
    write_room_capture(folder / "room")
    along = [((0.8 + 0.15 * i, 0.2 * (i % 3) - 0.2, -1.2), 0.1 * (i % 2), 0.0) for i in range(12)]
    write_room_capture(folder / "tiles", width=160, height=120, poses=along, color_at=tiled_color)
    (folder / "short.yaml").write_text(_SHORT)


def _set(*settings: str, prefix: str = "") -> list[str]:
    return [word for setting in settings for word in ("--set", prefix + setting)]


def _fly(folder: Path) -> list[str]:
    words = ["fly", "--scenario", f"{folder}/short.yaml", "--policy", "straight", "--overwrite"]
    return [*words, "--out", f"{folder}/out"]


def _reconstruct(folder: Path) -> list[str]:
    words = ["reconstruct", f"{folder}/room", "--overwrite", "--out", f"{folder}/out/scene"]
    return [*words, *_set(*_RECONSTRUCT)]


def _benchmark(jobs: int) -> Callable[[Path], list[str]]:
    def words(folder: Path) -> list[str]:
        words = ["benchmark", "--scenarios", f"{folder}/short.yaml", "--seeds", "3"]
        words += ["--policies", "straight,planner", "--jobs", str(jobs)]
        return [*words, "--out", f"{folder}/out"]

    return words


def _train(folder: Path) -> list[str]:
    return ["train", "diffaero", "--out", f"{folder}/out", *_set(*_TRAIN)]


def _ablate(folder: Path) -> list[str]:
    words = ["scene", "ablate", f"{folder}/tiles", "--out", f"{folder}/out"]
    return [*words, *_set(*_RECONSTRUCT)]


def _fidelity(folder: Path) -> list[str]:
    words = ["scene", "fidelity", f"{folder}/scene", "--overwrite", "--out", f"{folder}/out"]
    return [
        *words,
        *_set(*_RECONSTRUCT, prefix="reconstruct."),
        "--set",
        "stretches=[1, 2]",
        "--set",
        "kept=2",
    ]


VERBS = {
    "fly": Verb(_fly, "trajectory.npz scenario.yaml flight.mp4"),
    "reconstruct": Verb(_reconstruct, "scene/*"),
    "benchmark": Verb(_benchmark(1), "*.yaml rollouts.csv table.csv rollouts/* scenarios/*"),
    "benchmark, two workers": Verb(
        _benchmark(2), "*.yaml rollouts.csv table.csv rollouts/* scenarios/*"
    ),
    "train": Verb(_train, "*.npz curves.csv config.yaml"),
    "ablate": Verb(_ablate, "*.csv *.md tiles/*/*"),
    "fidelity": Verb(_fidelity, "*.csv */*/*", "scene/*", reads_scene=True),
}
"""By name."""


def clean(folder: Path) -> None:
    """Removes what a command has left."""
    shutil.rmtree(folder / "out", ignore_errors=True)
