"""What the command line checks before it imports anything slow: names and paths."""

import sys
from collections.abc import Sequence
from pathlib import Path

from splatpilot.analysis.benchmark.variants import SCENARIO, Variant
from splatpilot.diagrams.scenario_files import (
    benchmark_scenarios,
    other_scenarios,
    scenario_file,
)
from splatpilot.systems.environment import find_data, require_corpus
from splatpilot.systems.files import require_existing
from splatpilot.systems.messages import did_you_mean, require
from splatpilot.systems.registry import check_name

SCENARIOS = tuple(benchmark_scenarios() | other_scenarios())
"""The names of the scenarios that come with the program."""

POLICIES = (
    "planner",
    "straight",
    "reactive",
    "diffaero",
    "depthnav",
    "agile_autonomy",
    "diffaero_tof",
    "diffaero_rgb",
    "student_rgb",
    "student_depth",
    "pilot_rgb",
)
"""The names of our own policies."""

TRAINERS = (
    "diffaero",
    "depthnav",
    "diffaero_tof",
    "agile_autonomy",
    "diffaero_rgb",
    "student_rgb",
    "student_depth",
)
"""The names of our own trainers."""

LEARN_FROM_CORPORA = "student_rgb", "student_depth", "diffaero_rgb"
"""Those of them that learn from corpora."""

_SUFFIXES = {
    **dict.fromkeys((".gltf", ".glb", ".obj"), "mesh"),
    **dict.fromkeys((".ply", ".spz", ".splat"), "gaussians"),
    **dict.fromkeys((".yaml", ".yml"), "scenario"),
    ".bt": "map",
}
_FLY = "fly in it with `splatpilot fly --scene {path}`"
_KINDS = {
    "mesh": (
        "a mesh",
        "render a capture of it with `splatpilot capture render {path} --out out/capture` (--up z "
        "where z points up in it), then `splatpilot reconstruct out/capture --out out/scene`",
    ),
    "capture": ("a capture", "make a scene of it with `splatpilot reconstruct {path} --out SCENE`"),
    "scene": ("a scene folder", _FLY),
    "gaussians": ("a file of Gaussians", _FLY),
    "map": ("an OctoMap", _FLY),
    "scenario": ("a scenario", "fly it with `splatpilot fly --scenario {path}`"),
}
"""What may be named as an environment, and what to do with it."""


def check_policy(variant: Variant) -> None:
    """
    Raises:
        FileNotFoundError: if the file of weights that it names is not there.
        ValueError: if there is no policy of its name.
    """
    if variant.weights is not None:
        require_existing(variant.weights, "a file of weights")
    elif variant.policy != SCENARIO:
        name, colon, field = variant.policy.partition(":")
        if colon and name in POLICIES:
            raise ValueError(
                f"the policy {variant.policy!r} names a field of {name} without a value; write "
                f"{name}:{field}=VALUE"
            )
        registry = "splatpilot.diagrams.policies"
        _check_name("policy", "splatpilot.policies", variant.policy, POLICIES, registry)


def check_trainer(name: str) -> None:
    """
    Raises:
        ValueError: if there is no trainer of this name.
    """
    registry = "splatpilot.training.policies.registry"
    _check_name("trainer", "splatpilot.trainers", name, TRAINERS, registry)


def _check_name(what: str, group: str, name: str, ours: Sequence[str], registry: str) -> None:
    # Once the registry has been imported, as by modules that --import names, it may know more.
    if registry not in sys.modules:
        check_name(what, group, name, ours)


def check_scenario(name: str) -> None:
    """
    Raises:
        FileNotFoundError: if the file that it names is not there.
        ValueError: if there is no scenario of this name.
    """
    require_existing(scenario_file(name), "a scenario")


def check_corpora(policies: Sequence[str], overrides: Sequence[str], config: Path | None) -> None:
    """
    Raises:
        FileNotFoundError: if one of the policies is trained on corpora, and one of these is not
            there. What a file of the configuration names is left to the training.
    """
    given = [text.partition("=")[2] for text in overrides if text.startswith("corpora=")]
    if (config is not None and not given) or not set(LEARN_FROM_CORPORA) & set(policies):
        return
    corpora = ["out/corpus"]
    if given:
        import yaml

        corpora = yaml.safe_load(given[-1])
    for corpus in corpora if isinstance(corpora, list) else ():
        require_corpus(Path(str(corpus)))


def check_config(path: Path | None) -> None:
    """
    Raises:
        FileNotFoundError: if a file of a configuration is named and not there.
    """
    if path is not None:
        require_existing(path, "a YAML file of a configuration")


def check_kind(path: Path, *accepted: str) -> None:
    """
    Args:
        path: of something that is there.
        accepted: keys of `_KINDS`.

    Raises:
        ValueError: if it is of another kind; the message says which, and what to do with it.
    """
    kind = _SUFFIXES.get(path.suffix.lower(), "")
    if path.is_dir():
        kind = "scene" if (path / "scene.yaml").is_file() else ""
        if not kind and "capture" not in accepted and _is_capture(path):
            kind = "capture"
    if kind and kind not in accepted:
        what, remedy = _KINDS[kind]
        require(False, str(path), _listed(accepted), what, remedy.format(path=path))


def _listed(kinds: Sequence[str]) -> str:
    *most, last = (_KINDS[kind][0] for kind in kinds)
    return f"{', '.join(most)} or {last}" if most else last


def _is_capture(path: Path) -> bool:
    # It takes seconds to import, and only a message needs it.
    from splatpilot.training.captures.read_capture import CAPTURES

    return any(CAPTURES.find(name).recognizes(path) for name in CAPTURES.names())


def find_place(place: Path, *accepted: str) -> Path:
    """
    Finds what is named as an environment: a scenario that comes with the program, or see
    `find_data`.

    Args:
        accepted: keys of `_KINDS`.

    Raises:
        FileNotFoundError: if it is nowhere.
        ValueError: see `check_kind`.
    """
    if "scenario" in accepted and str(place) in SCENARIOS:
        return place
    scenarios = SCENARIOS if "scenario" in accepted else ()
    found = find_data(place, _listed(accepted), did_you_mean(str(place), scenarios))
    check_kind(found, *accepted)
    return found
