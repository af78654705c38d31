"""`make crash`: commands ended by kill -9, SIGTERM, a full disk and lost permission at random
moments, the same command again, and a table of what was lost."""

import argparse
import collections
import sys
import tempfile
from pathlib import Path

from crash.campaign import WAYS, Campaign, Round
from crash.verbs import VERBS


def main() -> int:
    parser = argparse.ArgumentParser(prog="crash", description=__doc__)
    parser.add_argument("verbs", nargs="*", help=f"of {', '.join(VERBS)}; all by default")
    parser.add_argument("--rounds", type=int, default=7, help="of each command in each way")
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=WAYS)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    names = options.verbs or list(VERBS)
    rounds: list[Round] = []
    with tempfile.TemporaryDirectory(prefix="crash-") as root:
        campaign = Campaign(Path(root))
        print(f"{'command':<24}" + "".join(f"{way:>16}" for way in options.ways), flush=True)
        for name in names:
            row: collections.Counter[str] = collections.Counter()
            for way in options.ways:
                for number in range(options.rounds):
                    rounds.append(campaign.round(name, way, options.seed + number))
                    row[way] += not rounds[-1].wrong
            cells = "".join(f"{f'{row[way]} of {options.rounds}':>16}" for way in options.ways)
            print(f"{name:<24}{cells}", flush=True)
            for each in rounds[-len(options.ways) * options.rounds :]:
                if each.wrong:
                    print(f"    {each.way} at {each.moment}: {each.wrong}", flush=True)
    wrong = sum(bool(each.wrong) for each in rounds)
    missed = sum(each.missed for each in rounds)
    print(
        f"{len(rounds) - wrong} of {len(rounds)} rounds lost nothing; in {missed} of them the "
        "command had ended by itself before its moment"
    )
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
