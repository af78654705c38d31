"""The option `--set FIELD=VALUE` that every configured verb has."""

import argparse


def add_overrides(parser: argparse.ArgumentParser, example: str) -> None:
    """Adds `--set`, whose values arrive in `options.overrides`."""
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        dest="overrides",
        metavar="FIELD=VALUE",
        help=f"override one field of the configuration, for example {example} (repeatable)",
    )
