"""Files of trained policies, `.npz`: weights, architecture and provenance."""

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from splatpilot.systems.common.files import written_atomically
from splatpilot.systems.common.readers import error_summary, read_archive
from splatpilot.systems.common.validation import require

FORMAT = 1  # It changes with the meaning of observations and commands.

_MAX_WEIGHT = 1e6  # Sums of products with observations stay in single precision.

_SHIPPED = Path(__file__).parent / "weights"


@dataclass(frozen=True, eq=False)
class PolicyCheckpoint:
    """Content of a file of weights."""

    policy: str  # name, as in the benchmark
    spec: Any  # architecture of the network, a dataclass
    weights: Mapping[str, np.ndarray]
    provenance: dict[str, Any]  # command, configuration, revision and success, in types of JSON
    path: Path | None = None

    def build[Network](self, make: Callable[[Any, dict[str, np.ndarray]], Network]) -> Network:
        """Makes the network from the architecture and the weights; errors name the file."""
        try:
            return make(self.spec, dict(self.weights))
        except ValueError as error:
            raise ValueError(f"{self.path}: {error}; {_remedy(self.policy)}") from None

    def save(self, path: Path) -> None:
        """Writes `path` atomically."""
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
        """Reads the weights of `policy` from a file, the shipped ones if `path` is None or empty;
        `spec` is the required architecture, or a function that makes one from its fields."""
        path = Path(path) if path else shipped_weights(policy)
        about, weights = _read(path, policy)
        found = f"{about['policy']!r} in format {about['format']}"
        needed = f"{policy!r} in format {FORMAT}"
        require(found == needed, f"the policy of {path}", needed, found, _remedy(policy))
        fields, differing = about["spec"], ""
        if callable(spec):
            try:
                spec = spec(**fields)
            except (TypeError, ValueError) as error:
                differing = str(error)
        else:
            expected = json.loads(json.dumps(asdict(spec)))
            differing = ", ".join(
                f"{name} must be {expected.get(name)}, got {fields.get(name)}"
                for name in expected | fields
                if fields.get(name) != expected.get(name)
            )
        if differing:
            raise ValueError(f"architecture of {path}: {differing}; {_remedy(policy)}")
        return cls(policy, spec, weights, about["provenance"], path)


def shipped_weights(policy: str) -> Path:
    """Returns the shipped file of weights of a policy."""
    return _SHIPPED / f"{policy}.npz"


def checkpoint_policy(path: str | Path) -> str:
    """Reads the name of the policy from a file of weights."""
    return _read(Path(path), "POLICY")[0]["policy"]


def _remedy(policy: str) -> str:
    return f"train them with: splatpilot train {policy} --out DIR"


def _read(path: Path, policy: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Reads the description and the weights."""
    if not path.is_file():
        raise FileNotFoundError(f"No such file of weights: {path}; {_remedy(policy)}")
    try:
        weights = read_archive(path)
        about = json.loads(str(weights.pop("about")))
        for name, kind in (("format", int), ("policy", str), ("spec", dict), ("provenance", dict)):
            require(isinstance(about[name], kind), name, f"of type {kind.__name__}", about[name])
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        reason = error_summary(error)
        raise ValueError(
            f"{path} must hold weights of a policy ({reason}); {_remedy(policy)}"
        ) from None
    return about, weights


def check_weights(
    weights: Mapping[str, np.ndarray], shapes: Mapping[str, tuple[int, ...]]
) -> dict[str, np.ndarray]:
    """Returns the arrays in `shapes`, in single precision; raises ValueError if one is missing, of
    another shape or not finite."""
    for name, shape in shapes.items():
        found = weights[name].shape if name in weights else "none"
        require(found == shape, f"the weights {name}", f"of shape {shape}", found)
        values = weights[name]
        finite = values.dtype.kind == "f" and (np.abs(values.astype(float)) <= _MAX_WEIGHT).all()
        limit = f"finite numbers up to {_MAX_WEIGHT:g}"
        require(finite, f"the weights {name}", limit, "others")
    return {name: np.asarray(weights[name], np.float32) for name in shapes}


def linear_shapes(*layers: tuple[str, int, int]) -> dict[str, tuple[int, ...]]:
    """Returns the shapes of weights by name of linear layers: name, inputs and outputs."""
    shapes: dict[str, tuple[int, ...]] = {}
    for name, inputs, outputs in layers:
        shapes[f"{name}.weight"], shapes[f"{name}.bias"] = (outputs, inputs), (outputs,)
    return shapes


def linear(weights: Mapping[str, np.ndarray], name: str, x: np.ndarray) -> np.ndarray:
    """Applies the linear layer `name` to x (..., inputs)."""
    return x @ weights[f"{name}.weight"].T + weights[f"{name}.bias"]


def require_shape(name: str, array: np.ndarray, shape: tuple[int, ...], remedy: str = "") -> None:
    """Checks the shape of an input of a network."""
    found = np.shape(array)
    require(found == shape, f"shape of the policy's {name}", str(shape), found, remedy)
