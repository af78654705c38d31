"""Distributions in numeric fields of configurations: reading, writing and sampling.

They are those of `pydrake.common.schema`. In YAML a tag names them, as in
`drag: !Uniform {min: 0.3, max: 0.5}`.
"""

import copy
import copyreg
import dataclasses
import hashlib
import re
from collections.abc import Iterator
from types import NoneType
from typing import Any, NamedTuple, get_args, get_origin

import numpy as np
import yaml
from pydrake.common import RandomGenerator, schema
from pydrake.common.schema import (
    Deterministic,
    DeterministicVectorX,
    Distribution,
    DistributionVector,
    Gaussian,
    GaussianVectorX,
    Rotation,
    Transform,
    Uniform,
    UniformDiscrete,
    UniformVectorX,
)
from pydrake.common.yaml import yaml_dump_typed, yaml_load_typed

from splatpilot.systems.common.readers import yaml_collections
from splatpilot.systems.common.validation import require

FieldPath = tuple[str | int, ...]
"""The path to a value in a configuration: names of fields, keys and indices."""

_STRUCTURAL = {"seed", "width", "height"}  # whole numbers that must not be drawn
_TRANSFORM = re.compile(r"X_[A-Z]{2}")  # Drake's reader reads the distributions in these.


def _name(kind: type) -> str:
    return kind.__name__.partition("𝓣")[0]  # without the parameters of a vector's template


_KINDS: dict[str, Any] = {
    f"!{_name(kind)}": kind
    for kind in (
        *(Deterministic, Gaussian, Uniform, UniformDiscrete),
        *(DeterministicVectorX, GaussianVectorX, UniformVectorX),
    )
}


def pickle_by_fields(*kinds: type) -> None:
    """Lets `pickle` carry values of Drake's configuration types, which have no pickling."""
    for kind in kinds:
        copyreg.pickle(kind, _reduce)


def _reduce(value: Any) -> tuple[Any, ...]:
    fields = {field.name: getattr(value, field.name) for field in config_fields(value)}
    return _from_fields, (type(value), fields)


def _from_fields(kind: Any, fields: dict[str, Any]) -> Any:
    value = kind()
    for name, part in fields.items():
        setattr(value, name, part)
    return value


_TAG = re.compile(rf"({'|'.join(_KINDS)})\b")


pickle_by_fields(Rotation, Transform)
pickle_by_fields(*(part for part in vars(Rotation).values() if isinstance(part, type)))
for _kind in vars(schema).values():
    if isinstance(_kind, type) and issubclass(_kind, Distribution | DistributionVector):
        pickle_by_fields(_kind)


class DrawnField(NamedTuple):
    """A field, or an item of one, that holds a distribution."""

    path: FieldPath
    holder: Any  # the configuration, dictionary or list that holds it
    distribution: Distribution | DistributionVector | Transform

    @property
    def name(self) -> str:
        """The dotted path."""
        return dotted(self.path)

    def put(self, value: Any) -> None:
        """Replaces the distribution."""
        if isinstance(self.holder, dict | list):
            self.holder[self.path[-1]] = value  # pyright: ignore
        else:
            object.__setattr__(self.holder, str(self.path[-1]), value)


def dotted(path: FieldPath) -> str:
    """Joins a path with dots."""
    return ".".join(map(str, path))


def is_distribution(value: Any) -> bool:
    """Returns True for distributions of numbers and of vectors."""
    return isinstance(value, Distribution | DistributionVector)


def has_distributions(value: Any) -> bool:
    """Checks if `find_distributions` yields any, without paths and types, which cost more."""
    if value is None or isinstance(value, str | float | int | Rotation | type):
        return False
    if isinstance(value, dict | list):
        return any(map(has_distributions, value.values() if isinstance(value, dict) else value))
    if isinstance(value, Transform):
        return not value.IsDeterministic()
    fields = config_fields(value)
    return is_distribution(value) or any(has_distributions(getattr(value, f.name)) for f in fields)


def distribution_text(distribution: Any) -> str:
    """Returns a distribution as YAML in one line."""
    return yaml.serialize(_node(distribution), width=float("inf")).strip()


def find_distributions(config: Any, path: FieldPath = ()) -> Iterator[DrawnField]:
    """Yields the distributions in the configuration at `path`, and transforms that have one; raises
    ValueError for a distribution in a field that is not of numbers, or an invalid one."""
    for field in () if isinstance(config, Transform | Rotation) else config_fields(config):
        yield from _find(config, (*path, field.name), getattr(config, field.name), field.type)


def config_fields(config: Any) -> tuple[Any, ...]:
    """Returns the fields of a dataclass or of a type of Drake's; none of other values."""
    is_ours = dataclasses.is_dataclass(config)
    return dataclasses.fields(config) if is_ours else tuple(getattr(config, "__fields__", ()))


def _find(holder: Any, path: FieldPath, value: Any, kind: Any) -> Iterator[DrawnField]:
    if is_distribution(value):
        _check(path, value, kind)
        yield DrawnField(path, holder, value)
    elif isinstance(value, Transform):
        if not value.IsDeterministic():
            yield DrawnField(path, holder, value)
    elif isinstance(value, dict | list):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        kinds = [each for each in get_args(_without_none(kind)) if each is not NoneType]
        for key, item in items:
            yield from _find(value, (*path, key), item, kinds[-1] if kinds else None)
    elif not isinstance(value, type):
        yield from find_distributions(value, path)


def _without_none(kind: Any) -> Any:
    """Returns the type T of `T | None`, or else the type itself."""
    options = [each for each in get_args(kind) if each is not NoneType]
    return options[0] if len(options) == 1 and NoneType in get_args(kind) else kind


def _check(path: FieldPath, distribution: Any, kind: Any) -> None:
    """Raises ValueError unless a field of this type can have the distribution."""
    kind, text, name = _without_none(kind), distribution_text(distribution), dotted(path)
    is_vector = get_origin(kind) is list or getattr(kind, "__name__", "") == "ndarray"
    if isinstance(distribution, DistributionVector):
        require(is_vector, name, "one value", text, "only lists of numbers have such distributions")
    else:
        require(not is_vector, name, "a list", text, "write !UniformVector or !GaussianVector")
        valid = kind is float or (kind is int and path[-1] not in _STRUCTURAL)
        require(valid, name, "one value", text, "only numbers can have a distribution")
    if kind is int:
        whole = isinstance(distribution, UniformDiscrete) and all(
            value == int(value) for value in distribution.values
        )
        require(whole, name, "a !UniformDiscrete of whole numbers", text)
    parts = {field.name: getattr(distribution, field.name) for field in config_fields(distribution)}
    require(len(parts.get("values", [0])) > 0, f"values of {name}", "at least one", text)
    if "max" in parts:
        valid = np.all(parts["min"] <= parts["max"])
        require(valid, f"min of {name}", "at most its max", text)
    if "stddev" in parts:
        require(np.all(parts["stddev"] >= 0.0), f"stddev of {name}", "at least 0", text)


def sample_distributions[Configuration](
    config: Configuration, seed: int, path: FieldPath = ()
) -> Configuration:
    """Returns the configuration with values drawn from its distributions, or itself without any.

    Each has a random stream of its own, of the seed and its path, which begins with `path`: a
    further distribution changes none of the other values.
    """
    if not has_distributions(config):
        return config
    config = copy.deepcopy(config)
    for field in list(find_distributions(config, path)):
        field.put(draw(field.distribution, seed, field.name))
    return config


def draw(distribution: Any, seed: int, name: str) -> Any:
    """Returns a value of a distribution, or of a transform that has one, by seed and name."""
    stream = hashlib.sha256(f"{seed} {name}".encode()).digest()
    value = distribution.Sample(RandomGenerator(int.from_bytes(stream[:4])))
    if isinstance(distribution, Transform):
        drawn = Transform(value)
        drawn.base_frame = distribution.base_frame
        return drawn
    if isinstance(distribution, DistributionVector):
        return value.tolist()
    whole = isinstance(distribution, UniformDiscrete) and value.is_integer()
    return int(value) if whole else value


def take_distributions(text: str, path: FieldPath = ()) -> tuple[str, dict[FieldPath, Any]]:
    """Returns a YAML text without the distributions in it, and these by their paths, which begin
    with `path`. Items of lists become 0. Transforms keep theirs."""
    root = yaml.compose(text, yaml.SafeLoader) if _TAG.search(text) else None
    if root is None:  # also of comments alone
        return text, {}
    for _, again in yaml_collections(root):  # Taking one from a node that stands twice takes both.
        require(not again, "YAML with distributions", "without *", "*", "write it out")
    found: dict[FieldPath, Any] = {}
    _take(root, path, found)
    return yaml.serialize(root), found


def _take(node: yaml.Node, path: FieldPath, found: dict[FieldPath, Any]) -> None:
    is_list = isinstance(node, yaml.SequenceNode)
    if not isinstance(node, yaml.CollectionNode):
        return
    kept = []
    for index, item in enumerate(node.value):
        key, value = (index, item) if is_list else (item[0].value, item[1])
        inner = (*path, key)
        if _TRANSFORM.fullmatch(str(key)):
            kept.append(item)
        elif value.tag in _KINDS:
            found[inner] = _read(value, inner)
            kept += [yaml.ScalarNode("tag:yaml.org,2002:int", "0")] if is_list else []
        else:
            _take(value, inner, found)
            kept.append(item)
    node.value = kept


def _read(node: yaml.Node, path: FieldPath) -> Any:
    kind = _KINDS[node.tag]
    names = {key.value for key, _ in node.value} if isinstance(node, yaml.MappingNode) else None
    known = [field.name for field in config_fields(kind)]
    form = f"{node.tag} {{{', '.join(f'{name}: ...' for name in known)}}}"
    require(names == set(known), dotted(path), form, yaml.serialize(node).strip())
    node.tag = "tag:yaml.org,2002:map"
    return yaml_load_typed(schema=kind, data=yaml.serialize(node))


def dump_config(config: Any) -> str:
    """Returns a configuration as YAML with every field."""
    if not any(is_distribution(field.distribution) for field in find_distributions(config)):
        return str(yaml_dump_typed(config))
    plain = copy.deepcopy(config)
    drawn = [p for p in find_distributions(plain) if is_distribution(p.distribution)]
    for field in drawn:
        field.put([] if isinstance(field.distribution, DistributionVector) else 0)
    root = yaml.compose(str(yaml_dump_typed(plain)), yaml.SafeLoader)
    for field in drawn:
        rows, row, node = [], 0, root
        for name in field.path:
            rows = node.value
            keys = [each[0].value for each in rows] if isinstance(node, yaml.MappingNode) else []
            row = keys.index(str(name)) if keys else int(name)
            node = rows[row][1] if keys else rows[row]
        node = _node(field.distribution)
        rows[row] = (rows[row][0], node) if isinstance(rows[row], tuple) else node
    return yaml.serialize(root)


def _node(distribution: Any) -> yaml.Node:
    """Returns the YAML node of a distribution, with its tag."""
    node = yaml.compose(str(yaml_dump_typed(distribution)), yaml.SafeLoader)
    node.tag, node.flow_style = f"!{_name(type(distribution))}", True
    return node
