"""The option `--set FIELD=VALUE` that every configured verb has."""

import argparse
import dataclasses
import math
import shutil
import sys
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatpilot.analysis.benchmark.variants import SCENARIO, Variant, parse_variant
from splatpilot.diagrams.scenarios import benchmark_scenarios, other_scenarios, scenario_file
from splatpilot.systems.common.files import (
    find_data,
    require_corpus,
    require_existing,
    require_scene,
)
from splatpilot.systems.common.registry import check_name
from splatpilot.systems.common.validation import did_you_mean, require


class SetField(argparse.Action):
    """Collects `FIELD=VALUE`; for `help` it prints the fields that there are instead, and ends."""

    def __init__(
        self, *args: Any, configuration: Callable[[argparse.Namespace], Any], **keywords: Any
    ) -> None:
        super().__init__(*args, **keywords)
        self.configuration = configuration

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        if values == "help":
            from splatpilot.analysis.commands.settings import format_settings  # imports Drake

            print(format_settings(self.configuration(namespace)))
            parser.exit()
        if "=" not in values:
            raise argparse.ArgumentError(None, f"--set must be FIELD=VALUE, got {values!r}")
        setattr(namespace, self.dest, [*getattr(namespace, self.dest), values])


def add_overrides(
    parser: argparse.ArgumentParser,
    examples: Sequence[str],
    configuration: Callable[[argparse.Namespace], Any],
) -> None:
    """
    Adds `--set`, whose values arrive in `options.overrides`.

    Args:
        examples: FIELD=VALUE of the fields that matter most.
        configuration: what they are fields of, from the options that were read before.
    """
    parser.add_argument(
        "--set",
        action=SetField,
        default=[],
        dest="overrides",
        metavar="FIELD=VALUE",
        configuration=configuration,
        help=f"override one field of the configuration, for example {', '.join(examples)} "
        "(repeatable); --set help lists all",
    )


EXAMPLES = "examples:"


def add_verb(
    verbs: argparse._SubParsersAction,
    name: str,
    run: Callable[[argparse.Namespace], Any] | None,
    *,
    help: str,
    description: str,
    examples: Sequence[str],
) -> argparse.ArgumentParser:
    """
    Adds a verb, or an action of one.

    Args:
        name: of it.
        run: is called with the options, and returns what `--json` prints where the verb has that
            option; None for a verb that has actions.
        help: half a sentence, for the list of verbs.
        description: whole sentences.
        examples: commands, what comes behind `splatpilot`.
    """
    width = max(shutil.get_terminal_size().columns - 2, 40)
    lines = [EXAMPLES, *(f"  splatpilot {example}" for example in examples)]
    parser = verbs.add_parser(
        name,
        help=help,
        description=textwrap.fill(description, width),
        epilog="\n".join(lines),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    if run is not None:
        parser.set_defaults(verb=run)
    return parser


def add_named(
    parser: argparse.ArgumentParser, *flags: str, names: Sequence[str], **keywords: Any
) -> None:
    """Adds an option or argument for which shells complete these names, and files."""
    option: Any = parser.add_argument(*flags, **keywords)
    option.completer = lambda **_: names


def add_json(parser: argparse.ArgumentParser, what: str) -> None:
    """Adds `--json`, which prints what the verb's function returns, and nothing else, on standard
    output."""
    parser.add_argument(
        "--json", action="store_true", help=f"print {what} as JSON; all else goes to standard error"
    )


def add_overwrite(parser: argparse.ArgumentParser) -> None:
    """Adds `--overwrite`."""
    parser.add_argument(
        "--overwrite", action="store_true", help="replace what is there; else it is an error"
    )


class FailureWithResultError(ValueError):
    """A failure with a result that `--json` prints."""

    def __init__(self, message: str, result: Any) -> None:
        super().__init__(message)
        self.result = result


def as_json(value: Any) -> Any:
    """A result as what JSON can hold; numbers that are none, which it cannot, as null."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return as_json(dataclasses.asdict(value))
    if isinstance(value, dict):
        return {str(name): as_json(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [as_json(one) for one in value]
    value = getattr(value, "item", lambda: value)()  # of a number of numpy
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if isinstance(value, str | int | float | None) else str(value)


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
"""Kinds of environments: their name, and the command that uses one."""


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
        registry = "splatpilot.diagrams.flight.policies"
        _check_name("policy", "splatpilot.policies", variant.policy, POLICIES, registry)


def check_trainer(name: str) -> None:
    """
    Raises:
        ValueError: if there is no trainer of this name.
    """
    registry = "splatpilot.training.policies.trainer_registry"
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
    from splatpilot.training.captures.capture_registry import CAPTURES

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


if TYPE_CHECKING:
    from splatpilot.diagrams.flight.scenario import Scenario


def add_scenario(parser: argparse.ArgumentParser) -> None:
    """Adds the options that `read_scenario` reads."""
    add_named(
        parser,
        "--scenario",
        names=SCENARIOS,
        metavar="P02|FILE.yaml",
        help="the scenario to fly: the benchmark's, or a file",
    )
    add_named(
        parser,
        "--policy",
        names=POLICIES,
        metavar="NAME[:FIELD=VALUE]",
        help="who flies, as in the benchmark: planner, straight, reactive, diffaero, depthnav, "
        "agile_autonomy, ..., a file of weights, or module:Class",
    )
    parser.add_argument("--speed", type=float, metavar="M/S", help="nominal, of any policy")
    parser.add_argument(
        "--scene",
        type=Path,
        metavar="DIR_OR_FILE",
        help="fly in this scene folder, file of Gaussians (PLY, SPZ, .splat; meters, z up) or "
        "OctoMap (.bt)",
    )
    parser.add_argument("--seed", type=int, help="seed of the world and the start")
    add_overrides(
        parser,
        ("timeout=20", "goal=[12,0,2]", "world.spacing=2.4", "policy.lattice.margin=0.2"),
        read_scenario,
    )


def check_scenario_options(options: argparse.Namespace) -> None:
    """
    Checks, before anything slow is imported, what the options name.

    Raises:
        OSError, ValueError: for what is not there.
    """
    if options.scenario is not None:
        check_scenario(options.scenario)
    if options.policy is not None:
        check_policy(parse_variant(options.policy))
    if options.scene is not None:
        check_kind(require_scene(str(options.scene)), "scene", "gaussians", "map")


def read_scenario(options: argparse.Namespace) -> "Scenario":
    """
    The scenario that the options name, with what they change of it.

    Raises:
        OSError, ValueError: for what is not there, or cannot be.
    """
    check_scenario_options(options)
    from splatpilot.diagrams.flight.policies import DEFAULT_SPEED, at_speed
    from splatpilot.diagrams.flight.scenario import Scenario
    from splatpilot.diagrams.scenarios import scenario_file
    from splatpilot.diagrams.worlds.world_registry import scene_config
    from splatpilot.systems.common.config import load_config

    file = None if options.scenario is None else scenario_file(options.scenario)
    scenario = load_config(Scenario(), file)
    if options.policy is not None:
        scenario.policy = parse_variant(options.policy).config(DEFAULT_SPEED, scenario.policy)
    if options.speed is not None:
        scenario.policy = at_speed(scenario.policy, options.speed)
    if options.scene is not None:
        scenario.world = scene_config(require_scene(str(options.scene)).absolute())
    if options.seed is not None:
        scenario.seed = options.seed
    return load_config(scenario, overrides=options.overrides)


def name_of_flight(options: argparse.Namespace, scenario: "Scenario") -> str:
    """Names a flight by its scenario, scene or world, policy, speed and seed, as studies do."""
    from splatpilot.analysis.benchmark.study import flight_name
    from splatpilot.diagrams.flight.policies import name_of, speed_of

    place = options.scene or options.scenario
    if place is None:
        place = type(scenario.world).__name__.removesuffix("Config").lower()
    variant = None if options.policy is None else parse_variant(options.policy)
    policy = name_of(scenario.policy) if variant is None else variant.label
    return flight_name(Path(place).stem, policy, speed_of(scenario.policy), scenario.seed)
