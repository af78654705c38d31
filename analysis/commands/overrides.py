"""The option `--set FIELD=VALUE` that every configured verb has."""

import argparse
from collections.abc import Callable, Sequence
from typing import Any


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
            from splatpilot.analysis.settings import format_settings

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
