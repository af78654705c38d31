"""`splatpilot merge`."""

import argparse
from pathlib import Path


def add_to(verbs: argparse._SubParsersAction) -> None:
    merge = verbs.add_parser(
        "merge",
        help="join the shards of a study",
        description="Joins what `splatpilot benchmark --shard` has left in the folders SHARD into "
        "the study OUT, which is then as if it had been flown whole.",
    )
    merge.set_defaults(verb=_merge)
    merge.add_argument("out", type=Path, metavar="OUT", help="folder of the study")
    merge.add_argument(
        "shards", type=Path, nargs="+", metavar="SHARD", help="folders of all shards"
    )


def _merge(options: argparse.Namespace) -> None:
    from splatpilot.analysis.benchmark import merge

    merge.run(out=options.out, shards=options.shards)
