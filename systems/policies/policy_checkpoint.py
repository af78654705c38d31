"""Files of trained policies: weights, architecture and how they were made, in one .npz."""

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from splatpilot.systems.array_files import read_archive, reason_of
from splatpilot.systems.files import written_atomically

FORMAT = 1
"""Of the file; observations and commands that mean something else make another number."""

_LARGEST = 1e6  # A sum of products with what is seen does not leave single precision.

_SHIPPED = Path(__file__).parent / "weights"


@dataclass(frozen=True, eq=False)
class PolicyCheckpoint:
    """What a file holds."""

    policy: str
    """Name of the policy, as in the benchmark."""
    spec: Any
    """Architecture of the network, a dataclass."""
    weights: Mapping[str, np.ndarray]
    provenance: dict[str, Any]
    """How it was made: command, config, seed, revision and success, as what JSON can hold."""
    path: Path | None = None
    """The file, if it was read from one."""

    def build[Network](self, make: Callable[[Any, dict[str, np.ndarray]], Network]) -> Network:
        """The network that `make` makes of the architecture and the weights.

        Raises:
            ValueError: for weights that it refuses; the message names the file.
        """
        try:
            return make(self.spec, dict(self.weights))
        except ValueError as error:
            raise ValueError(
                f"{self.path}: {error}; train them with: splatpilot train {self.policy} --out DIR"
            ) from None

    def save(self, path: Path) -> None:
        """Writes `path`, whole or not at all."""
        about = {
            "format": FORMAT,
            "policy": self.policy,
            "spec": asdict(self.spec),
            "provenance": self.provenance,
        }
        with written_atomically(path) as partial:
            arrays: dict[str, Any] = dict(self.weights)
            np.savez_compressed(partial, about=json.dumps(about), **arrays)

    @classmethod
    def load(cls, path: str | Path | None, policy: str, spec: Any) -> "PolicyCheckpoint":
        """Reads the weights of `policy` from a file, those that ship if `path` is None or empty.

        Args:
            spec: the architecture that the file must be of, or the type of those it may be of.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it is damaged, or of another policy, version or architecture.
        """
        path = Path(path) if path else shipped_weights(policy)
        remedy = f"train them with: splatpilot train {policy} --out DIR"
        about, weights = _read(path, remedy)
        found_format, found_policy = about["format"], about["policy"]
        found_spec, provenance = about["spec"], about["provenance"]
        if (found_format, found_policy) != (FORMAT, policy):
            raise ValueError(
                f"{path} holds weights of the policy {found_policy!r} in format {found_format}, "
                f"but needed is {policy!r} in format {FORMAT}; {remedy}"
            )
        if isinstance(spec, type):
            try:
                return cls(policy, spec(**found_spec), weights, provenance, path)
            except (TypeError, ValueError) as error:
                raise ValueError(
                    f"{path} holds weights of another architecture ({error}); {remedy}"
                ) from None
        expected = json.loads(json.dumps(asdict(spec)))
        if found_spec != expected:
            differing = [
                f"{name} {found_spec.get(name)} instead of {value}"
                for name, value in expected.items()
                if found_spec.get(name) != value
            ]
            raise ValueError(
                f"{path} holds weights of another architecture ({', '.join(differing)}); {remedy}"
            )
        return cls(policy, spec, weights, provenance, path)


def shipped_weights(name: str) -> Path:
    """The file of weights that ships under the name of a policy."""
    return _SHIPPED / f"{name}.npz"


def policy_of(path: str | Path) -> str:
    """The name of the policy that a file holds weights of.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it holds no weights.
    """
    return _read(Path(path), "train some with: splatpilot train POLICY --out DIR")[0]["policy"]


def _read(path: Path, remedy: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """What a file says of itself, and its weights."""
    if not path.is_file():
        raise FileNotFoundError(f"there are no weights at {path}; {remedy}")
    try:
        weights = read_archive(path)
        about = json.loads(str(weights.pop("about")))
    except (OSError, ValueError, KeyError, RecursionError) as error:
        reason = reason_of(error)
        raise ValueError(f"{path} holds no weights of a policy ({reason}); {remedy}") from None
    about = about if isinstance(about, dict) else {}
    for name, kind in (("format", int), ("policy", str), ("spec", dict), ("provenance", dict)):
        if not isinstance(about.get(name), kind):
            raise ValueError(f"{path} holds no weights of a policy (no {name}); {remedy}")
    return about, weights


def check_weights(
    weights: Mapping[str, np.ndarray], shapes: Mapping[str, tuple[int, ...]]
) -> dict[str, np.ndarray]:
    """The arrays that `shapes` names, in single precision.

    Raises:
        ValueError: if one is missing, of another shape or not finite.
    """
    for name, shape in shapes.items():
        if name not in weights or weights[name].shape != shape:
            found = weights[name].shape if name in weights else "missing"
            raise ValueError(f"the weights {name} are {found}, but must be of shape {shape}")
        values = weights[name]
        if values.dtype.kind != "f" or not (np.abs(values.astype(float)) <= _LARGEST).all():
            raise ValueError(f"the weights {name} are not all finite numbers up to {_LARGEST:g}")
    return {name: np.asarray(weights[name], np.float32) for name in shapes}
