"""Commands of `splatpilot` and their options: each option is declared once."""

import argparse
import dataclasses
import inspect
import math
import pkgutil
import shutil
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatpilot.analysis.benchmark.variants import parse_variant
from splatpilot.analysis.commands import checks
from splatpilot.systems.common.files import require_existing, require_scene, require_unused

if TYPE_CHECKING:
    from splatpilot.diagrams.flight.scenario import Scenario


class Option:
    """An option or argument of commands. `resolve` checks a value before slow imports, and returns
    it or what it names; the path of an `unused` option must not exist without --overwrite; of
    `exclusive` ones at most one is given."""

    def __init__(
        self,
        spec: str,
        help: str,
        type: Callable[[str], Any] = str,
        *,
        resolve: Callable[[Any], Any] | None = None,
        unused: bool = False,
        completions: Sequence[str] = (),
        exclusive: bool = False,
        **keywords: Any,
    ) -> None:
        self.flag, _, metavar = spec.partition(" ")
        self.resolve, self.unused, self.exclusive = resolve, unused, exclusive
        self.completions = completions
        self.keywords: dict[str, Any] = (
            keywords | {"help": help} | ({"metavar": metavar} if metavar else {})
        )
        if keywords.get("action", "append") == "append":
            self.keywords["type"] = type
        self.name = keywords.get("dest") or self.flag.lstrip("-").replace("-", "_")


def flag(name: str, help: str) -> Option:
    """Declares an option without a value."""
    return Option(name, help, action="store_true")


@dataclass(frozen=True)
class Command:
    """A command, such as "fly", or a subcommand, such as "scene scale"."""

    name: str
    examples: Sequence[str]  # command lines without `splatpilot`
    options: Sequence[Option]
    function: Callable[[argparse.Namespace], Any]
    """Returns what `--json` prints; its docstring is the description."""

    def fill(self, parser: argparse.ArgumentParser) -> None:
        """Adds description, examples and options to the parser of the command."""
        width = max(shutil.get_terminal_size().columns - 2, 40)
        parser.description = textwrap.fill(inspect.getdoc(self.function) or "", width)
        parser.epilog = "\n  splatpilot ".join(["examples:", *self.examples])
        parser.formatter_class = argparse.RawDescriptionHelpFormatter
        exclusive = any(each.exclusive for each in self.options)
        group = parser.add_mutually_exclusive_group() if exclusive else parser
        for each in self.options:
            target = group if each.exclusive else parser
            action: Any = target.add_argument(each.flag, **each.keywords)
            if each.completions:
                action.completer = lambda *, names=each.completions, **_: names
            if isinstance(action, SetField):
                parser.set_defaults(default_config=action.configuration)
        parser.set_defaults(command=self)

    def run(self, options: argparse.Namespace) -> Any:
        """Checks the options and runs the command."""
        for each in self.options:
            value = getattr(options, each.name)
            if each.unused and value is not None:
                require_unused(value, options.overwrite)
            if each.resolve is not None and value is not None:
                several = isinstance(value, list)
                resolved = [*map(each.resolve, value)] if several else each.resolve(value)
                setattr(options, each.name, resolved)
        return self.function(options)


def command(
    name: str, *options: Option, examples: Sequence[str]
) -> Callable[[Callable[[argparse.Namespace], Any]], Command]:
    """Decorates the function of a command; for the arguments see `Command`."""
    return lambda function: Command(name, examples, options, function)


def announce(text: str) -> None:
    """Says what a command does, before slow imports."""
    from splatpilot.systems.common.progress import say

    say(text)


def call(function: Callable[..., Any], options: argparse.Namespace, **given: Any) -> Any:
    """Calls a function with the given arguments, and with options for its other parameters."""
    names = inspect.signature(function).parameters
    return function(**{n: getattr(options, n) for n in names if hasattr(options, n)} | given)


class FailureWithResultError(ValueError):
    """A failure with a result that `--json` prints."""

    def __init__(self, message: str, result: Any) -> None:
        super().__init__(message)
        self.result = result


def as_json(value: Any) -> Any:
    """Converts a result to what JSON holds; NaN and infinity become null."""
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


class SetField(argparse.Action):
    """Collects `FIELD=VALUE`; for `help` it prints all fields and exits."""

    def __init__(
        self, *args: Any, configuration: Callable[[argparse.Namespace], Any], **keywords: Any
    ) -> None:
        super().__init__(*args, **keywords)
        self.configuration = configuration

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, values: Any, *_: Any
    ) -> None:
        if values == "help":
            from splatpilot.systems.common.config import format_fields  # imports Drake

            print(format_fields(self.configuration(namespace)))
            parser.exit()
        if "=" not in values:
            raise argparse.ArgumentError(None, f"--set must be FIELD=VALUE, got {values!r}")
        setattr(namespace, self.dest, [*getattr(namespace, self.dest), values])


def set_option(*examples: str, configuration: str | Callable[[argparse.Namespace], Any]) -> Option:
    """Declares `--set`, with FIELD=VALUE as examples, of a configuration: `module:type`, or a
    function that makes it from the options before `--set`."""

    def make_default(options: argparse.Namespace) -> Any:
        return pkgutil.resolve_name(str(configuration))()

    return Option(
        "--set FIELD=VALUE",
        f"override one field of the configuration, for example {', '.join(examples)} "
        "(repeatable); --set help lists all",
        action=SetField,
        default=[],
        dest="overrides",
        configuration=configuration if callable(configuration) else make_default,
    )


def read_config(options: argparse.Namespace, **changes: Any) -> Any:
    """Reads `--config` and `--set` over a command's defaults with the `changes` that are not
    None."""
    from splatpilot.systems.common.config import load_config

    config = options.default_config(options)
    for name, value in changes.items():
        if value is not None:
            setattr(config, name, value)
    file = getattr(options, "config", None)
    return load_config(config, file, options.overrides)


def path_option(spec: str, what: str, *kinds: str, **keywords: Any) -> Option:
    """Declares an option or argument for existing paths, with `what` there, of these kinds if any,
    see `check_kind`; scenes may be given by name, see `locate_scene`."""

    def check(path: Path) -> Path:
        if "scene" in kinds:
            path = require_scene(str(path))
        else:
            require_existing(path, what)
        if kinds:
            checks.check_kind(path, *kinds)
        return path

    return Option(spec, what, Path, resolve=check, **keywords)


def input_option(name: str, *kinds: str, **keywords: Any) -> Option:
    """Declares an argument for environments of these kinds, see `find_input`."""
    help = checks.describe_kinds(kinds)
    return Option(name, help, resolve=lambda path: checks.find_input(path, *kinds), **keywords)


def json_option(what: str) -> Option:
    """Declares `--json`: the result of the command is all that goes to standard output."""
    return flag("--json", f"print {what} as JSON; everything else goes to standard error")


def out_option(help: str, default: str | None = None, **keywords: Any) -> Option:
    """Declares `--out`, required unless it has a default or `required` is False."""
    if default is not None:
        keywords["default"], help = Path(default), f"{help} (%(default)s)"
    keywords = {"required": default is None} | keywords
    return Option("--out", help, Path, **keywords)


OVERWRITE = flag("--overwrite", "replace existing output, otherwise an error")
CONFIG = path_option("--config FILE", "a YAML file of a configuration")
JOBS = Option("--jobs N", "worker processes; default: cores", int)
SEED = Option("--seed", "seed of a generated world", int)
UP = Option("--up", "axis of the mesh file that points up", choices=("y", "z"))


def read_scenario(options: argparse.Namespace) -> "Scenario":
    """Reads the scenario of `SCENARIO_OPTIONS`, with values drawn from its distributions."""
    from splatpilot.diagrams.flight.policies import DEFAULT_SPEED, at_speed
    from splatpilot.diagrams.flight.scenario import Scenario, sample_scenario
    from splatpilot.diagrams.scenarios import scenario_file
    from splatpilot.diagrams.worlds.world_registry import scene_config
    from splatpilot.systems.common.config import load_config

    file = None if options.scenario is None else scenario_file(options.scenario)
    scenario = load_config(Scenario(), file)
    if options.policy is not None:
        scenario.policy = parse_variant(options.policy).config(DEFAULT_SPEED, scenario.policy)
    if options.speed is not None:
        scenario.policy = at_speed(scenario.policy, options.speed)
    if options.scene is not None:  # not resolved yet if --set help follows
        scenario.world = scene_config(require_scene(str(options.scene)).absolute())
    if options.seed is not None:
        scenario.seed = options.seed
    return sample_scenario(load_config(scenario, overrides=options.overrides))


SCENARIO_OPTIONS = (
    Option(
        "--scenario P02|FILE.yaml",
        "name of a benchmark scenario, or a scenario file",
        resolve=checks.check_scenario,
        completions=checks.SCENARIOS,
    ),
    Option(
        "--policy NAME[:FIELD=VALUE]",
        f"policy: {', '.join(checks.POLICY_NAMES)}, a file of weights, or module:Class",
        resolve=checks.check_policy,
        completions=checks.POLICY_NAMES,
    ),
    Option("--speed M/S", "nominal speed of the policy", float),
    path_option(
        "--scene DIR_OR_FILE",
        "fly in this scene folder, file of Gaussians (meters, z up) or OctoMap (.bt)",
        *("scene", "gaussians", "map"),
    ),
    Option("--seed", "seed of the world and the start", int),
    set_option(
        *("timeout=20", "goal=[12,0,2]", "world.spacing=2.4", "policy.lattice.margin=0.2"),
        configuration=read_scenario,
    ),
)
"""The options that `read_scenario` reads."""
