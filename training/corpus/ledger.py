"""The ledger of a corpus: where everything comes from, a row for each flight."""

import csv
from pathlib import Path
from typing import Any

from splatpilot.systems.files import written_atomically
from splatpilot.training.corpus.corpus import LEDGER, Corpus
from splatpilot.training.corpus.sample import SOURCES


def write_ledger(folder: Path, corpus: Corpus) -> None:
    """Writes `ledger.csv` anew, from what the shards say.

    Raises:
        OSError: if it cannot be written.
    """
    rows: list[dict[str, Any]] = []
    for shard in corpus.shards:
        same = {
            "shard": shard.path.name,
            "world": shard.world,
            "source": SOURCES[shard.source],
            "revision": shard.revision,
        }
        rows += [same | flight for flight in shard.flights]
    columns = list(dict.fromkeys(name for row in rows for name in row))
    with written_atomically(folder / LEDGER) as path, path.open("w", newline="") as file:
        table = csv.DictWriter(file, columns, lineterminator="\n")
        table.writeheader()
        table.writerows(rows)
