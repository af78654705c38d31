"""`splatpilot merge`."""

import argparse
from pathlib import Path
from typing import Any

from splatpilot.analysis.commands.benchmark import require_flown
from splatpilot.analysis.commands.options import add_json, add_verb
from splatpilot.systems.common.files import require_existing


def add_to(verbs: argparse._SubParsersAction) -> None:
    merge = add_verb(
        verbs,
        "merge",
        _merge,
        help="join the shards of a study",
        description="Joins what `splatpilot benchmark --shard` has left in the folders SHARD into "
        "the study OUT, which is then as if it had been flown whole.",
        examples=("merge out/study shards/1 shards/2", "merge out/study shards/1 shards/2 --json"),
    )
    merge.add_argument("out", type=Path, metavar="OUT", help="folder of the study")
    merge.add_argument(
        "shards", type=Path, nargs="+", metavar="SHARD", help="folders of all shards"
    )
    add_json(merge, "the rows of table.csv")


def _merge(options: argparse.Namespace) -> Any:
    for shard in options.shards:
        require_existing(shard, "the folder of a shard")
    from splatpilot.analysis.benchmark import merge

    table = merge.run(out=options.out, shards=options.shards)
    require_flown(table)
    return table
