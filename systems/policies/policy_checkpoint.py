"""Files of trained policies: weights, architecture and how they were made, in one .npz."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flysplat.systems.files import written_atomically
from flysplat.systems.policies.recurrent_network import NetworkSpec, RecurrentNetwork

FORMAT = 1
"""Of the file; observations and commands that mean something else make another number."""

_SHIPPED = Path(__file__).parent / "weights"


@dataclass(frozen=True, eq=False)
class PolicyCheckpoint:
    """What a file holds."""

    policy: str
    """Name of the policy, as in the benchmark."""
    spec: NetworkSpec
    weights: Mapping[str, np.ndarray]
    provenance: dict[str, Any]
    """How it was made: command, config, seed, revision, time and success, as what JSON can hold."""

    def save(self, path: Path) -> None:
        """Writes `path`, whole or not at all."""
        about = {
            "format": FORMAT,
            "policy": self.policy,
            "spec": self.spec.to_dict(),
            "provenance": self.provenance,
        }
        with written_atomically(path) as partial:
            np.savez_compressed(partial, about=json.dumps(about), **self.weights)

    @classmethod
    def load(cls, path: str | Path | None, policy: str) -> "PolicyCheckpoint":
        """Reads the weights of `policy` from a file, those that ship if `path` is None or empty.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it is damaged, or of another policy or version.
        """
        path = Path(path) if path else _SHIPPED / f"{policy}.npz"
        remedy = f"train them with: flysplat train {policy} --out DIR"
        if not path.is_file():
            raise FileNotFoundError(f"there are no weights at {path}; {remedy}")
        try:
            with np.load(path, allow_pickle=False) as file:
                about = json.loads(str(file["about"]))
                weights = {name: file[name] for name in file.files if name != "about"}
            found = about["format"], about["policy"]
            spec = NetworkSpec.from_dict(about["spec"]) if found == (FORMAT, policy) else None
        except Exception as error:
            raise ValueError(f"{path} holds no weights of a policy ({error}); {remedy}") from None
        if spec is None:
            raise ValueError(
                f"{path} holds weights of the policy {found[1]!r} in format {found[0]}, but needed "
                f"is {policy!r} in format {FORMAT}; {remedy}"
            )
        return cls(policy, spec, weights, about["provenance"])

    def network(self, expected: NetworkSpec) -> RecurrentNetwork:
        """The network in the file, which must be of the architecture `expected`.

        Raises:
            ValueError: if it is not.
        """
        if self.spec != expected:
            differing = [
                f"{name} {value} instead of {getattr(expected, name)}"
                for name, value in self.spec.to_dict().items()
                if value != expected.to_dict()[name]
            ]
            raise ValueError(
                f"the weights of {self.policy!r} are of another architecture: "
                f"{', '.join(differing)}; train them with this version"
            )
        return RecurrentNetwork(self.spec, self.weights)
