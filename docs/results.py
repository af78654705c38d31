"""Stores the results of studies, and renders the tables and figures of pages from them.

python docs/results.py keep out/study development
python docs/results.py keep_realism out/realism
python docs/results.py write
python docs/results.py pdf

`docs/results/NAME.csv` has the numbers. `NAME.yaml` has the command, the date, the machine and the
program, as far as they are known, and in `columns` the format of each cell by the heading.

A table of a page is between `<!-- table KIND NAME -->` and `<!-- end of table -->`. A number is
before `<!-- value NAME "ROW" "FORMAT" -->`, where ROW is the text of the first column. Figures are
`docs/report/NAME.svg`, see `report_figures.py`.
"""

import argparse
import csv
import hashlib
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable
from contextlib import suppress
from datetime import date
from functools import cache
from pathlib import Path
from string import Formatter
from typing import Any, NamedTuple

import numpy as np
import report_figures
import yaml

from splatpilot.analysis.benchmark.study import StudyConfig
from splatpilot.analysis.benchmark.study_folder import StudyFolder
from splatpilot.analysis.benchmark.tables import (
    PAPER,
    PAPER_FLIGHTS,
    cluster_interval,
    select,
    wilson_interval,
)
from splatpilot.analysis.reconstruction.fidelity import band
from splatpilot.analysis.twin import predictions
from splatpilot.diagrams.scenarios import benchmark_scenarios
from splatpilot.systems.common.files import write_csv
from splatpilot.systems.common.provenance import describe_seeds

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs" / "results"
REPORT = ROOT / "docs" / "report"
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), REPORT / "index.md"]
STUDY = "test"
"""The study of the report: development or test."""

TABLE = re.compile(r"(<!-- table (\w+) (\w+) -->\n).*?(<!-- end of table -->)", re.DOTALL)
VALUE = re.compile(r"[^\s(|]*(<!-- value ([^>]*) -->)")

Row = dict[str, Any]

_OUTCOMES = "collision", "timeout", "left_volume", "infeasible"
_SUMS = {"clearance_sum_m": "min_clearance_m", "speed_sum_m_s": "mean_speed_m_s"}
"""Columns with sums over feasible flights, by column of `rollouts.csv`."""


def keep(study: str, name: str) -> None:
    """Stores the results of a study as `name`."""
    folder, rows = StudyFolder(Path(study)), []
    config, flown = folder.config(), read_rows(folder.path / "rollouts.csv")
    key = "policy", "speed", "scenario"
    for values in dict.fromkeys(tuple(row[column] for column in key) for row in flown):
        row: Row = dict(zip(key, values, strict=True))
        flights = select(flown, **row)
        row |= {"flights": len(flights), "successes": sum(f["success"] == "True" for f in flights)}
        row |= {outcome: sum(f["outcome"] == outcome for f in flights) for outcome in _OUTCOMES}
        for sum_name, column in _SUMS.items():
            row[sum_name] = f"{sum(float(f[column]) for f in flights if f[column]):.4f}"
        rows.append(row)
    timing = folder.read_timing(config.rollouts()[0].id)
    about = {
        "split": config.split,
        "seeds": config.seeds,
        "date": max(map(_date, (folder.path / "rollouts").glob("*.npz"))),
        "machine": f"{_processor()}, kernels for {timing['simd']}",
        "command": _command(config),
        "program": folder.program(),
    }
    _store(name, rows, about)


def keep_realism(*folders: str) -> None:
    """Stores the results of `splatpilot.analysis.realism`, of different policies in each folder."""
    rows = [row for folder in folders for row in read_rows(Path(folder) / "realism.csv")]
    order = list(dict.fromkeys(row["conditions"] for row in rows))
    rows.sort(key=lambda row: order.index(row["conditions"]))
    commands, programs = [], set[str]()
    for folder in map(Path, folders):
        ideal = StudyFolder(folder / "ideal")
        config, effects = ideal.config(), folder.glob("*/study.yaml")
        fewest = min(StudyFolder(path.parent).config().seeds for path in effects)
        options = f"--policies {','.join(config.policies)} --seeds {config.seeds}"
        command = f"python -m splatpilot.analysis.realism {folder} {options}"
        commands.append(f"{command} --effect-seeds {fewest}")
        programs.add(ideal.program()["splatpilot"])
    (program,) = programs
    about = {"command": "; ".join(commands), "date": _date(Path(folders[0]) / "realism.csv")}
    _store("realism", rows, about | {"program": program})


def read_rows(file: Path) -> list[dict[str, str]]:
    """Reads the rows of a CSV file."""
    return list(csv.DictReader(file.read_text().splitlines()))


def _store(name: str, rows: list[Row], about: dict[str, Any]) -> None:
    RESULTS.mkdir(exist_ok=True)
    write_csv(RESULTS / f"{name}.csv", rows)
    (RESULTS / f"{name}.yaml").write_text(yaml.safe_dump(about, sort_keys=False, width=1000))


def _date(file: Path) -> str:
    return date.fromtimestamp(file.stat().st_mtime).isoformat()


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
    """Stored results."""

    rows: list[Row]
    about: dict[str, Any]

    @classmethod
    @cache
    def read(cls, name: str) -> "Results":
        """Reads or computes the results `name`; "study" is the study of the report."""
        name = STUDY if name == "study" else name
        if name in DERIVED:
            compute, source = DERIVED[name]
            rows = list(compute(cls.read(source).rows if source else []))
        else:
            texts = read_rows(RESULTS / f"{name}.csv")
            rows = [{key: _number(text) for key, text in row.items()} for row in texts]
        return cls(rows, _about(name))

    @property
    def scenarios(self) -> list[str]:
        return list(dict.fromkeys(row["scenario"] for row in self.rows))

    def description(self) -> str:
        """Describes seeds, date, program, machine and command in Markdown."""
        about = self.about
        seeds = describe_seeds(about["split"], about["seeds"]).capitalize()
        command = about["command"].replace(" --scenarios", " \\\n    --scenarios")
        return (
            f"{seeds}, {len(self.scenarios)} scenarios, flown on {about['date']} by program "
            f"`{_program(about)}` on {about['machine']}:\n\n```\n{command}\n```\n"
        )


def _about(name: str) -> dict[str, Any]:
    file = RESULTS / f"{name}.yaml"
    return yaml.safe_load(file.read_text()) if file.is_file() else {}


def _number(text: str) -> int | float | str:
    for kind in (int, float):
        with suppress(ValueError):
            return kind(text)
    return text


def _program(about: dict[str, Any]) -> str:
    """Returns the first digits of the revision, with the mark of uncommitted changes."""
    program = about.get("program", "")
    revision = program["splatpilot"] if isinstance(program, dict) else program
    return revision[:7] + revision[40:] if re.match(r"[0-9a-f]{40}", revision) else revision


def success_rows(results: list[Row]) -> Iterable[Row]:
    """Yields success rates with intervals, and means over feasible flights, by policy and speed;
    and the paper's."""
    for policy, speed in dict.fromkeys((row["policy"], row["speed"]) for row in results):
        rows = select(results, policy=policy, speed=speed)
        counts = [(row["successes"], row["flights"]) for row in rows]
        successes, flights = total(rows, "successes"), total(rows, "flights")
        these = wilson_interval(successes, flights)
        new = cluster_interval([k for k, _ in counts], [n for _, n in counts])
        generated = [row for row in rows if row["scenario"].startswith("P")]
        flown = flights - total(rows, "infeasible")
        yield {
            "policy": policy,
            "speed": speed,
            "successes": successes,
            "flights": flights,
            "rate": successes / flights,
            "low": these.lower,
            "high": these.upper,
            "new_low": new.lower,
            "new_high": new.upper,
            "generated": total(generated, "successes"),
            "generated_flights": total(generated, "flights"),
            "passed": sum(2 * k > n for k, n in counts),
            "scenarios": len(rows),
            "clearance_m": total(rows, "clearance_sum_m") / flown if flown else np.nan,
            "speed_m_s": total(rows, "speed_sum_m_s") / flown if flown else np.nan,
            **{outcome: total(rows, outcome) for outcome in _OUTCOMES},
            **(_paper_row(policy) if policy in PAPER else {}),
        }


def _paper_row(policy: str) -> Row:
    theirs = PAPER[policy]
    limits = wilson_interval(theirs.successes, PAPER_FLIGHTS)
    row = theirs._asdict() | {"policy": policy, "flights": PAPER_FLIGHTS}
    row |= {"low": limits.lower, "high": limits.upper}
    return {f"paper_{name}": value for name, value in row.items()}


def twins(pairs: list[Row]) -> Iterable[Row]:
    """Yields the agreement of flights in scenes and meshes, by environment and of all."""
    for row in predictions(pairs):
        these = [pair for pair in pairs if row["environment"] in (pair["environment"], "all")]
        gaps = [
            pair["splat_clearance_m"] - pair["mesh_clearance_m"]
            for pair in these
            if pair["splat"] and pair["mesh"]
        ]
        yield row | {
            "splat_only": sum(pair["splat"] > pair["mesh"] for pair in these),
            "mesh_only": sum(pair["mesh"] > pair["splat"] for pair in these),
            "clearance_gap_m": float(np.median(gaps)),
        }


def twin_policies(pairs: list[Row]) -> Iterable[Row]:
    """Yields each policy's success in meshes and scenes."""
    for policy in dict.fromkeys(pair["policy"] for pair in pairs):
        these = select(pairs, policy=policy)
        rates = {kind: total(these, kind) / len(these) for kind in ("mesh", "splat")}
        yield {"policy": policy, "flights": len(these), **rates}


def off_path(views: list[Row]) -> Iterable[Row]:
    """Yields medians and percentiles 10 and 90 of views off the path, by scene and offset."""
    for scene in dict.fromkeys(view["scene"] for view in views):
        these = select(views, scene=scene)
        offsets = [view["offset"] for view in these]
        metrics = "psnr_db", "depth_mae_m", "depth_relative"
        bands = {name: band(offsets, [view[name] for view in these]) for name in metrics}
        for k, offset in enumerate(bands["psnr_db"].at):
            row: Row = {"scene": scene, "offset_m": offset, "views": bands["psnr_db"].counts[k]}
            for name, found in bands.items():
                row |= {name: found.middle[k], f"{name}_low": found.low[k]}
                row[f"{name}_high"] = found.high[k]
            yield row


def trainings(_: list[Row]) -> Iterable[Row]:
    """Yields seed, minutes and program of the training of the weights, from their cards."""
    for card in sorted((ROOT / "systems" / "policies" / "weights").glob("*.md")):
        text = " ".join(card.read_text().split())
        yield {
            "policy": card.stem,
            "seed": re.findall(r"\bseed: (\d+)", text)[0],
            "minutes": " + ".join(re.findall(r"in ([\d.]+) minutes of one core", text)),
            "program": re.findall(r"revision (\w{7})", text)[0],
        }


def sources(_: list[Row]) -> Iterable[Row]:
    """Yields command, date, machine and program of the results in the report."""
    shown: list[str] = re.findall(
        r"<!-- (?:table \w+|value) (\w+)", (REPORT / "index.md").read_text()
    )
    shown += report_figures.FIGURES.values()
    inputs = {"study": STUDY} | {name: source for name, (_, source) in DERIVED.items()}
    for name in sorted({inputs.get(name, name) for name in shown}):
        if name:
            about = Results.read(name).about
            row = {key: about.get(key, "") for key in ("command", "date", "machine")}
            yield {"file": f"{name}.csv", **row, "program": _program(about)}


DERIVED: dict[str, tuple[Callable[[list[Row]], Iterable[Row]], str]] = {
    "success": (success_rows, STUDY),
    "density_policies": (success_rows, "density"),
    "twins": (twins, "twin_flights"),
    "twin_policies": (twin_policies, "twin_flights"),
    "off_path": (off_path, "off_path_views"),
    "trainings": (trainings, ""),
    "sources": (sources, ""),
}
"""Results that are computed from other results, and the name of these."""


def total(rows: list[Row], column: str) -> Any:
    return sum(row[column] for row in rows)


def table(header: list[str], lines: list[list[str]]) -> str:
    return "\n".join(f"|{'|'.join(cells)}|" for cells in [header, ["---"] * len(header), *lines])


def cell(form: str, row: Row) -> str:
    """Formats a cell, which is empty if one of its values is missing."""
    names = [name for _, name, _, _ in Formatter().parse(form) if name]
    return "" if any(row.get(name, "") == "" for name in names) else form.format_map(row)


def columns(results: Results) -> str:
    """Renders a row for each row, by the formats in `columns`."""
    formats = results.about["columns"]
    return table(list(formats), [[cell(f, row) for f in formats.values()] for row in results.rows])


def policies(results: Results) -> str:
    rows = list(success_rows(results.rows))
    return f"{results.description()}\n{columns(Results(rows, _about('policies')))}"


def paper(results: Results) -> str:
    """Renders the paper's Table I next to our policies, and names scenarios that did not fly."""
    ours = [row for row in success_rows(results.rows) if row["policy"] in PAPER]
    others = [name for name in PAPER if name not in [row["policy"] for row in ours]]
    rendered = columns(Results([*ours, *map(_paper_row, others)], _about("paper")))
    missing = sorted(set(benchmark_scenarios()) - set(results.scenarios))
    unflown = f"This study did not fly {', '.join(missing)}."
    return f"{rendered}\n\n{unflown}" if missing else rendered


def pivot(results: Results, name: str) -> str:
    """Renders successes/flights by policy and the column `name`."""
    header = list(dict.fromkeys(row[name] for row in results.rows))
    lines: dict[str, dict[str, str]] = {}
    for row in results.rows:
        speed = f", {row['speed']:g} m/s" if "speed" in row else ""
        cells = lines.setdefault(f"`{row['policy']}`{speed}", {})
        cells[row[name]] = f"{row['successes']}/{row['flights']}"
    return table(
        ["policy", *header],
        [[policy, *(cells.get(each, "") for each in header)] for policy, cells in lines.items()],
    )


def scenarios(results: Results) -> str:
    return pivot(results, "scenario")


def realism(results: Results) -> str:
    """Renders successes and flights by policy and condition of `splatpilot.analysis.realism`."""
    seeds = "Successes/flights, test seeds from 1000 on"
    flown = f"{seeds}, flown on {results.about['date']} by program `{_program(results.about)}`:"
    return f"{flown}\n\n{pivot(results, 'conditions')}"


def rates(results: Results) -> str:
    """Renders success rates with intervals as a sentence."""
    form = "`{policy}` {rate:.0%} ({low:.0%} to {high:.0%})"
    found = "; ".join(cell(form, row) for row in success_rows(results.rows))
    seeds = describe_seeds(results.about["split"], results.about["seeds"])
    return f"Success in {len(results.scenarios)} scenarios, {seeds}: {found}."


KINDS: dict[str, Callable[[Results], str]] = {
    each.__name__: each for each in (columns, policies, paper, scenarios, realism, rates)
}


def with_tables(text: str) -> str:
    """Renders the tables and values in the text of a page."""

    def render(found: re.Match) -> str:
        begin, kind, name, end = found.groups()
        return f"{begin}\n{KINDS[kind](Results.read(name))}\n\n{end}"

    def value(found: re.Match) -> str:
        comment, words = found.groups()
        name, key, form = shlex.split(words)
        (row,) = [row for row in Results.read(name).rows if next(iter(row.values())) == key]
        return f"{cell(form, row)}{comment}"

    return VALUE.sub(value, TABLE.sub(render, text))


def figures() -> dict[str, report_figures.Figure]:
    """Draws the figures of the report by name."""
    return report_figures.draw_all(lambda name: Results.read(name).rows)


def write() -> None:
    """Renders the tables and the figures of all pages."""
    for page in PAGES:
        page.write_text(with_tables(page.read_text()))
    for name, figure in figures().items():
        (REPORT / f"{name}.svg").write_text(report_figures.svg(figure))


def pdf() -> None:
    """Prints the report to `docs/report/report.pdf`, by Sphinx and Chromium."""
    from playwright.sync_api import sync_playwright

    site = ROOT / "build" / "report"
    command = [sys.executable, "-m", "sphinx", "-q", "-c", str(ROOT / "docs"), str(REPORT)]
    # Links to other pages lead nowhere in a document of its own.
    subprocess.run([*command, "-D", "suppress_warnings=myst.xref_missing", str(site)], check=True)
    html = site / "index.html"
    html.write_text(re.sub(r'(<a [^>]*)href="(?!#|https:)[^"]*"', r"\1", html.read_text()))
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox"]
        )
        tab = browser.new_page()
        tab.goto(html.as_uri())
        printed = tab.pdf(format="A4", prefer_css_page_size=True)
        browser.close()
    # A comment at the end says which page it is of.
    (REPORT / "report.pdf").write_bytes(printed + report_digest())


def report_digest() -> bytes:
    """Returns the comment at the end of the PDF: a digest of the page and its figures."""
    parts = [REPORT / "index.md", *sorted(REPORT.glob("*.svg"))]
    digest = hashlib.sha256(b"".join(part.read_bytes() for part in parts)).hexdigest()
    return f"\n% of the page {digest}\n".encode()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("`docs/")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    known = {each.__name__: each for each in (keep, keep_realism, write, pdf)}
    parsers = {name: commands.add_parser(name, help=each.__doc__) for name, each in known.items()}
    parsers["keep"].add_argument("study")
    parsers["keep"].add_argument("name")
    parsers["keep_realism"].add_argument("folders", nargs="+")
    options = vars(parser.parse_args())
    chosen = options.pop("command")
    known[chosen](*options.pop("folders", ()), **options)
