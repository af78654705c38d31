"""`make fuzz`: damaged files and packets for every reader, and a table of what became of them.

Anything but a file that is accepted and can be used, or a refusal in one sentence that names it, is
a mistake, of which the case, and with it the damage, is printed:

    python -m fuzz.campaign READER CASE CASE+1 SEED
"""

import argparse
import concurrent.futures
import os
import sys

from fuzz.campaign import ALL, counts, run

WRONG = "traceback", "weak", "nonsense", "hang", "crash"


def main() -> int:
    parser = argparse.ArgumentParser(prog="fuzz", description=__doc__)
    parser.add_argument("readers", nargs="*", help=f"of {', '.join(ALL)}; all by default")
    parser.add_argument("--cases", type=int, default=10_000, help="of each reader")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    options = parser.parse_args()
    names = options.readers or list(ALL)
    columns = "accepted", "refused", *WRONG
    print(f"{'reader':<24}" + "".join(f"{column:>11}" for column in columns), flush=True)
    wrong = 0
    with concurrent.futures.ThreadPoolExecutor(options.jobs) as pool:
        found = pool.map(lambda name: run(name, options.cases, options.seed), names)
        for name, outcomes in zip(names, found, strict=True):
            row = counts(outcomes)
            print(f"{name:<24}" + "".join(f"{row[column]:>11}" for column in columns), flush=True)
            for case, kind, what in outcomes:
                if kind in WRONG:
                    wrong += 1
                    print(f"    {kind}, case {case}: {what}", flush=True)
    print(f"{wrong} of {options.cases * len(names)} cases are wrong")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
