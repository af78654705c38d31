"""Stores the results of studies, and renders the tables of pages from them.

python docs/results.py keep out/study development
python docs/results.py keep_realism out/realism
python docs/results.py write

`docs/results/NAME.csv` has a row for each policy, speed and scenario. `NAME.yaml` has the command,
the date, the machine and the program. A table of a page is between `<!-- table KIND NAME -->` and
`<!-- end of table -->`, where KIND is policies, paper or realism.
"""

import argparse
import csv
import re
import shlex
from collections.abc import Callable, Sequence
from datetime import date
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from splatpilot.analysis.benchmark.study import StudyConfig
from splatpilot.analysis.benchmark.study_folder import StudyFolder
from splatpilot.analysis.benchmark.tables import (
    PAPER,
    PAPER_FLIGHTS,
    Interval,
    cluster_interval,
    wilson_interval,
)
from splatpilot.diagrams.scenarios import benchmark_scenarios
from splatpilot.systems.common.provenance import describe_seeds

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs" / "results"
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
TABLE = re.compile(r"(<!-- table (\w+) (\w+) -->\n).*?(<!-- end of table -->)", re.DOTALL)

_OUTCOMES = "collision", "timeout", "left_volume", "infeasible"
_SUMS = {"clearance_sum_m": "min_clearance_m", "speed_sum_m_s": "mean_speed_m_s"}
"""Columns with sums over feasible flights, by column of `rollouts.csv`."""


def keep(study: Path, name: str) -> None:
    """Stores the results of a study as `name`."""
    folder = StudyFolder(study)
    config = folder.config()
    groups: dict[tuple[str, str, str], list[dict[str, str]]] = {}
    with (study / "rollouts.csv").open() as file:
        for row in csv.DictReader(file):
            groups.setdefault((row["policy"], row["speed"], row["scenario"]), []).append(row)
    rows = []
    for (policy, speed, scenario), flights in groups.items():
        row: dict[str, Any] = {"policy": policy, "speed": speed, "scenario": scenario}
        row |= {"flights": len(flights), "successes": sum(f["success"] == "True" for f in flights)}
        row |= {outcome: sum(f["outcome"] == outcome for f in flights) for outcome in _OUTCOMES}
        for sum_name, column in _SUMS.items():
            row[sum_name] = f"{sum(float(f[column]) for f in flights if f[column]):.4f}"
        rows.append(row)
    RESULTS.mkdir(exist_ok=True)
    with (RESULTS / f"{name}.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    timing = folder.read_timing(config.rollouts()[0].id)
    flown = max(path.stat().st_mtime for path in (study / "rollouts").glob("*.npz"))
    about = {
        "split": config.split,
        "seeds": config.seeds,
        "date": date.fromtimestamp(flown).isoformat(),
        "machine": f"{_processor()}, kernels for {timing['simd']}",
        "command": _command(config),
        "program": folder.program(),
    }
    (RESULTS / f"{name}.yaml").write_text(yaml.safe_dump(about, sort_keys=False, width=1000))


def keep_realism(folders: Sequence[Path]) -> None:
    """Stores the results of `splatpilot.analysis.realism`, of different policies in each folder."""
    rows = [
        row
        for folder in folders
        for row in csv.DictReader((folder / "realism.csv").read_text().splitlines())
    ]
    order = list(dict.fromkeys(row["conditions"] for row in rows))
    rows.sort(key=lambda row: order.index(row["conditions"]))
    with (RESULTS / "realism.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    flown = (folders[0] / "realism.csv").stat().st_mtime
    program = StudyFolder(folders[0] / "ideal").program()["splatpilot"]
    about = {"date": date.fromtimestamp(flown).isoformat(), "program": program}
    (RESULTS / "realism.yaml").write_text(yaml.safe_dump(about, sort_keys=False))


def _processor() -> str:
    models = re.findall(r"^model name\s*: (.*)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    return models[0] if models else "an unknown processor"


def _command(config: StudyConfig) -> str:
    words = ["splatpilot", "benchmark", "--split", config.split, "--seeds", str(config.seeds)]
    words += ["--speeds", ",".join(f"{speed:g}" for speed in config.speeds)]
    words += ["--policies", ",".join(config.policies)]
    words += ["--scenarios", ",".join(config.scenarios)]
    words += [word for override in config.overrides for word in ("--set", override)]
    return shlex.join([*words, "--out", "out/study"])


class Results(NamedTuple):
    """Stored results of a study."""

    rows: list[dict[str, str]]
    about: dict[str, Any]

    @classmethod
    def read(cls, name: str) -> "Results":
        with (RESULTS / f"{name}.csv").open() as file:
            rows = list(csv.DictReader(file))
        return cls(rows, yaml.safe_load((RESULTS / f"{name}.yaml").read_text()))

    @property
    def scenarios(self) -> list[str]:
        return list(dict.fromkeys(row["scenario"] for row in self.rows))

    @property
    def entries(self) -> list[tuple[str, str]]:
        """Pairs of policy and speed."""
        return list(dict.fromkeys((row["policy"], row["speed"]) for row in self.rows))

    def select(self, entry: tuple[str, str], scenarios: Sequence[str] = ()) -> list[dict[str, str]]:
        """Returns the rows of a policy and speed."""
        return [
            row
            for row in self.rows
            if (row["policy"], row["speed"]) == entry
            and (not scenarios or row["scenario"] in scenarios)
        ]

    def description(self) -> str:
        """Describes seeds, date, program, machine and command in Markdown."""
        about = self.about
        seeds = describe_seeds(about["split"], about["seeds"]).capitalize()
        program = about["program"]["splatpilot"]
        command = about["command"].replace(" --scenarios", " \\\n    --scenarios")
        return (
            f"{seeds}, {len(self.scenarios)} scenarios, flown on {about['date']} by program "
            f"`{program[:7]}{program[40:]}` on {about['machine']}:\n\n"
            f"```\n{command}\n```\n"
        )


def total(rows: list[dict[str, str]], column: str) -> int:
    return sum(int(row[column]) for row in rows)


def mean(rows: list[dict[str, str]], column: str) -> float:
    """Returns the mean over feasible flights from a column of sums."""
    flown = total(rows, "flights") - total(rows, "infeasible")
    return sum(float(row[column]) for row in rows) / flown if flown else float("nan")


def percent(interval: Interval) -> str:
    return f"{interval.lower:.0%} to {interval.upper:.0%}"


def table(header: list[str], lines: list[list[str]]) -> str:
    return "\n".join(
        "| " + " | ".join(cells) + " |" for cells in [header, ["---"] * len(header), *lines]
    )


def label(entry: tuple[str, str]) -> str:
    return f"`{entry[0]}`, {float(entry[1]):g} m/s"


def policies(results: Results) -> str:
    header = ["policy", "success", "these scenarios", "new scenarios", "P01 to P12"]
    header += ["scenarios passed", "clearance [m]", "velocity [m/s]"]
    header += ["collision, timeout, left, infeasible"]
    lines = []
    for entry in results.entries:
        rows = results.select(entry)
        flights, successes = total(rows, "flights"), total(rows, "successes")
        counts = [(int(row["successes"]), int(row["flights"])) for row in rows]
        generated = [row for row in rows if row["scenario"].startswith("P")]
        lines.append(
            [
                label(entry),
                f"{successes}/{flights} ({successes / flights:.0%})",
                percent(wilson_interval(successes, flights)),
                percent(cluster_interval([k for k, _ in counts], [n for _, n in counts])),
                f"{total(generated, 'successes')}/{total(generated, 'flights')}",
                f"{sum(2 * k > n for k, n in counts)}/{len(rows)}",
                f"{mean(rows, 'clearance_sum_m'):+.2f}",
                f"{mean(rows, 'speed_sum_m_s'):.2f}",
                ", ".join(str(total(rows, outcome)) for outcome in _OUTCOMES),
            ]
        )
    return results.description() + "\n" + table(header, lines)


def realism(results: Results) -> str:
    """Renders successes and flights by policy and condition of `splatpilot.analysis.realism`."""
    header = list(dict.fromkeys(row["conditions"] for row in results.rows))
    lines = []
    for policy in dict.fromkeys(row["policy"] for row in results.rows):
        cells = {
            row["conditions"]: f"{row['successes']}/{row['flights']}"
            for row in results.rows
            if row["policy"] == policy
        }
        lines.append([f"`{policy}`", *(cells.get(name, "") for name in header)])
    flown_on, program = results.about["date"], results.about["program"][:7]
    seeds = "Successes/flights, test seeds from 1000 on"
    flown = f"{seeds}, flown on {flown_on} by program `{program}`:"
    return f"{flown}\n\n{re.sub(' *[|] *', '|', table(['policy', *header], lines))}"


def paper(results: Results) -> str:
    missing = sorted(set(benchmark_scenarios()) - set(results.scenarios))
    if missing:
        return (
            f"This study did not fly {', '.join(missing)}, so there is no comparison with the "
            "paper's Table I."
        )
    header = ["policy", "method in the paper", "paper: passed, clearance, velocity"]
    header += ["here: passed, clearance, velocity"]
    lines = []
    for entry in results.entries:
        if entry[0] not in PAPER:
            continue
        rows, theirs = results.select(entry), PAPER[entry[0]]
        passed = sum(2 * int(row["successes"]) > int(row["flights"]) for row in rows)
        lines.append(
            [
                label(entry),
                theirs.method,
                f"{theirs.successes}/{PAPER_FLIGHTS}, {theirs.min_clearance_m:+.2f} m, "
                f"{theirs.mean_speed_m_s:.2f} m/s",
                f"{passed}/{len(rows)}, {mean(rows, 'clearance_sum_m'):+.2f} m, "
                f"{mean(rows, 'speed_sum_m_s'):.2f} m/s",
            ]
        )
    return table(header, lines)


KINDS: dict[str, Callable[[Results], str]] = {
    "policies": policies,
    "paper": paper,
    "realism": realism,
}


def with_tables(text: str) -> str:
    """Renders the tables in the text of a page."""

    def render(found: re.Match) -> str:
        begin, kind, name, end = found.groups()
        return f"{begin}\n{KINDS[kind](Results.read(name))}\n\n{end}"

    return TABLE.sub(render, text)


def write() -> None:
    """Renders the tables of all pages."""
    for page in PAGES:
        page.write_text(with_tables(page.read_text()))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("write", help=write.__doc__)
    keep_parser = commands.add_parser("keep", help=keep.__doc__)
    keep_parser.add_argument("study", type=Path)
    keep_parser.add_argument("name")
    realism_parser = commands.add_parser("keep_realism", help=keep_realism.__doc__)
    realism_parser.add_argument("folders", type=Path, nargs="+")
    options = vars(parser.parse_args())
    known = {"keep": keep, "keep_realism": keep_realism, "write": write}
    known[options.pop("command")](**options)
