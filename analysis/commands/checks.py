"""Checks of names and paths that the command line makes before slow imports."""

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from splatpilot.analysis.benchmark.variants import SCENARIO, parse_scenario, parse_variant
from splatpilot.diagrams.scenarios import benchmark_scenarios, other_scenarios, scenario_file
from splatpilot.systems.common.files import (
    SCENES,
    find_data,
    locate_scene,
    require_existing,
    scenes_folder,
)
from splatpilot.systems.common.registry import check_name
from splatpilot.systems.common.validation import did_you_mean, require

SCENARIOS = tuple(benchmark_scenarios() | other_scenarios())
"""The names of the scenarios of this package."""

LEARN_FROM_CORPORA = "student_rgb", "student_depth", "diffaero_rgb"
"""Trainers that learn from corpora."""

TRAINER_NAMES = (
    *("diffaero", "depthnav", "diffaero_tof", "agile_autonomy", "distilled_rgb"),
    *LEARN_FROM_CORPORA,
)
"""The names of the trainers of this package; importing their registry takes seconds."""

POLICY_NAMES = "planner", "straight", "teleop", "reactive", *TRAINER_NAMES
"""The names of the policies of this package."""

_SUFFIXES = {
    **dict.fromkeys((".gltf", ".glb", ".obj"), "mesh"),
    **dict.fromkeys((".ply", ".spz", ".sog", ".splat"), "gaussians"),
    **dict.fromkeys((".usd", ".usda", ".usdc", ".usdz"), "gaussians"),
    **dict.fromkeys((".yaml", ".yml"), "scenario"),
    ".bt": "map",
}
_FLY = "fly in it with `splatpilot fly --scene {path}`"
_KINDS = {
    "mesh": (
        "a mesh",
        "fly in it with `splatpilot fly --set 'world=!MeshWorld {{path: {path}}}'`, or render a "
        "capture of it with `splatpilot capture render {path} --out out/capture`, then `splatpilot "
        "reconstruct out/capture --out out/scene` (up: z and --up z if z points up in it)",
    ),
    "capture": ("a capture", "make a scene of it with `splatpilot reconstruct {path} --out SCENE`"),
    "scene": ("a scene folder", _FLY),
    "gaussians": ("a file of Gaussians", _FLY),
    "map": ("an OctoMap", _FLY),
    "scenario": ("a scenario", "fly it with `splatpilot fly --scenario {path}`"),
}
"""Kinds of environments: their name, and the command that uses one."""


def check_policy(text: str) -> str:
    """Checks the name of a policy, or its file of weights; returns the text."""
    variant = parse_variant(text)
    name, colon, field = variant.policy.partition(":")
    if variant.weights is not None:
        require_existing(variant.weights, "a file of weights")
    elif colon and name in POLICY_NAMES:
        raise ValueError(
            f"the policy {variant.policy!r} names a field of {name} without a value; write "
            f"{name}:{field}=VALUE"
        )
    elif variant.policy != SCENARIO:
        registry = "splatpilot.diagrams.flight.policies"
        _check_name("policy", "splatpilot.policies", variant.policy, POLICY_NAMES, registry)
    return text


def check_trainer(name: str) -> str:
    """Checks the name of a trainer, and returns it."""
    registry = "splatpilot.training.policies.train"
    _check_name("trainer", "splatpilot.trainers", name, TRAINER_NAMES, registry)
    return name


def _check_name(what: str, group: str, name: str, ours: Sequence[str], registry: str) -> None:
    # A registry that --import has loaded may have more names.
    if registry not in sys.modules:
        check_name(what, group, name, ours)


def check_scenario(name: str) -> str:
    """Checks the name or the file of a scenario, and returns it."""
    require_existing(scenario_file(name), "a scenario")
    return name


def check_study_scenario(text: str) -> str:
    """Checks a scenario of a study, with fields that are changed, and returns the text."""
    check_scenario(parse_scenario(text).scenario)
    return text


def check_kind(path: Path, *accepted: str) -> None:
    """Checks that an existing path is one of the `accepted` keys of `_KINDS`."""
    kind = _SUFFIXES.get(path.suffix.lower(), "")
    if kind == "mesh" and path.is_file() and b"KHR_gaussian_splatting" in path.read_bytes():
        kind = "gaussians"
    if path.is_dir():
        kind = "scene" if (path / "scene.yaml").is_file() else ""
        kind = "gaussians" if (path / "means_l.webp").is_file() else kind  # an unbundled SOG
        if not kind and "capture" not in accepted:
            remedy = f"of a capture, {_KINDS['capture'][1].format(path=path)}"
            require(kind, str(path), _list_kinds(accepted), "a folder without scene.yaml", remedy)
    if kind and kind not in accepted:
        what, remedy = _KINDS[kind]
        require(False, str(path), _list_kinds(accepted), what, remedy.format(path=path))


def _list_kinds(kinds: Sequence[str], described: Mapping[str, str] = {}) -> str:
    *first, last = (_KINDS[kind][0] + described.get(kind, "") for kind in kinds)
    return f"{', '.join(first)} or {last}" if first else last


def describe_kinds(kinds: Sequence[str]) -> str:
    """Lists kinds of environments with their suffixes, for the help of a command."""
    forms: dict[str, list[str]] = {"scenario": ["P02"]}
    for suffix, kind in _SUFFIXES.items():
        forms.setdefault(kind, []).append(suffix)
    return _list_kinds(kinds, {kind: f" ({', '.join(each)})" for kind, each in forms.items()})


def find_input(path: str, *accepted: str) -> str:
    """Finds an environment of an `accepted` kind: a scenario by name, or a path as `locate_scene`
    and `find_data` do."""
    scenarios = SCENARIOS if "scenario" in accepted else ()
    if path in scenarios:
        return path
    hint, scene = did_you_mean(path, scenarios), None
    if "scene" in accepted:
        scene = locate_scene(path)
        hint = hint or f"scenes are also looked for in {scenes_folder()} ({SCENES})"
    found = scene or find_data(Path(path), _list_kinds(accepted), hint)
    check_kind(found, *accepted)
    return str(found)
