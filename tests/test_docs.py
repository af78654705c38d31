import ast
import csv
import importlib
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import tomllib
import zlib
from argparse import Namespace
from functools import cache
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
import report_figures
import results
from stable_baselines3 import PPO

import splatpilot as sp
from splatpilot.analysis.commands.checks import SCENARIOS
from splatpilot.analysis.commands.main import build_parser, main
from splatpilot.analysis.commands.options import read_scenario
from splatpilot.diagrams.flight.policies import POLICIES, policy_named
from splatpilot.diagrams.gym.sb3 import Sb3FlightEnv
from splatpilot.diagrams.hardware.bridge import HardwareConfig
from splatpilot.diagrams.hardware.px4 import Px4Config
from splatpilot.systems.common.config import describe_fields
from splatpilot.systems.common.files import write_csv
from splatpilot.training.captures.capture_config import CaptureConfig

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
DOCS = ROOT / "docs"
GUIDES = sorted(DOCS.glob("*.md"))
PAGES = [*sorted(ROOT.glob("*.md")), *GUIDES, *sorted((DOCS / "tutorials").glob("*.md"))]
PAGES.append(results.REPORT / "index.md")
FLOORS = "systems", "diagrams", "training", "analysis"
FOREIGN_MESSAGES = {
    "CMAKE_CXX_COMPILER not set",
    "externally-managed-environment",
    "Failed to establish a new connection",
    "Could not resolve host",
    "No space left on device",
}
IMAGE = re.compile(r"!\[[^]]*\]\(([^)]+)\)")


def blocks(page: Path, *languages: str) -> list[str]:
    """Returns the code blocks of a page in these languages."""
    found = re.findall(r"^```(\S*)\n(.*?)^```$", page.read_text(), re.DOTALL | re.MULTILINE)
    return [code for language, code in found if language in languages]


def commands(page: Path) -> list[list[str]]:
    """Returns the commands in the code blocks of a page, as words; shell variables are 1."""
    text = "\n".join(blocks(page, "", "bash")).replace("\\\n", " ").replace("&&", "\n")
    text = re.sub(r"\$\w+", "1", text)
    lines = [shlex.split(line, comments=True) for line in text.splitlines()]
    return [[word for word in words if word != "&"] for words in lines if words]


def default_config(options: Namespace) -> Any:
    """Makes the configuration that a command's `--set` changes, without reading files."""
    if options.command.name == "view" and options.what not in SCENARIOS:
        return CaptureConfig()
    if options.default_config is not read_scenario:
        return options.default_config(options)
    scenario = sp.Scenario()
    if options.policy in POLICIES.names():
        scenario.policy = policy_named(options.policy)
    return scenario


@pytest.mark.parametrize("page", PAGES, ids=[page.stem for page in PAGES])
def test_commands_parse_and_their_fields_can_be_set(page, hedgehop, monkeypatch):
    for module in ("climber", "hedges"):
        importlib.import_module(f"hedgehop.{module}")
    # Readers write the modules that pages name.
    monkeypatch.setattr("splatpilot.systems.common.registry.import_modules", lambda names: None)
    pictures = runpy.run_path(str(DOCS / "pictures.py"))["make_parser"]()
    for words in commands(page):
        words = words[1:] if words[0] == "srun" else words
        if words[:2] == ["python", "docs/pictures.py"]:
            pictures.parse_args(words[2:])
        if words[0] != "splatpilot" or words[-1] == "help":
            continue
        options = build_parser().parse_args(words[1:])
        if hasattr(options, "overrides") and ":" not in (getattr(options, "policy", "") or ""):
            sp.load_config(default_config(options), overrides=options.overrides)


@pytest.mark.parametrize(
    "page", [p for p in PAGES if blocks(p, "yaml")], ids=lambda page: page.stem
)
def test_files_are_configurations(page, tmp_path):
    for text in blocks(page, "yaml"):
        if text.startswith("apiVersion:"):
            continue
        named = set(re.findall(r"^(\w+):", text, re.MULTILINE))
        kinds = [Px4Config()] if "motion_capture" in named else [sp.Scenario(), HardwareConfig()]
        fields = [{field.name for field in describe_fields(kind)} for kind in kinds]
        (config,) = (kind for kind, known in zip(kinds, fields, strict=True) if named <= known)
        (tmp_path / "file.yaml").write_text(text)
        sp.load_config(config, tmp_path / "file.yaml").validate()


@pytest.mark.parametrize(
    "page", [p for p in GUIDES if blocks(p, "python")], ids=lambda page: page.stem
)
def test_python_runs(page, viewer, registered):
    names: dict[str, Any] = {"__name__": "__main__"}
    for code in blocks(page, "python"):
        exec(code, names)
    if "flight" in names:
        assert names["flight"].summary()["outcome"] in ("goal", "collision")


def test_trained_models_fly_as_the_page_says(tmp_path, monkeypatch, registered):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    [code] = (each for each in blocks(DOCS / "gym.md", "python") if "GymPolicy" in each)
    Path("my_ppo.py").write_text(code)
    world = sp.load_config(sp.Scenario(), overrides=["world.length=9"])
    envs = Sb3FlightEnv(2, world, num_worlds=1, observation=["state", "goal", "obstacle"])
    PPO("MultiInputPolicy", envs, seed=0).save("out/ppo")
    words = ["fly", "--policy", "my_ppo:PpoConfig", "--set", "world.length=9", "--no-video"]
    assert main([*words, "--set", "timeout=1", "--out", "flown"]) == 0
    assert "!PpoConfig" in Path("flown/scenario.yaml").read_text()


@pytest.mark.parametrize("page", PAGES, ids=[page.stem for page in PAGES])
def test_links_lead_somewhere(page):
    text = re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        if link.startswith("https://"):
            continue
        assert target.exists(), link
        if anchor:
            headings = re.findall(r"^#+ (.*)$", target.read_text(), re.MULTILINE)
            kept = [re.sub(r"[^\w\- ]", "", heading.lower()).strip() for heading in headings]
            assert anchor in [heading.replace(" ", "-") for heading in kept], link


def test_messages_of_troubleshooting_are_those_of_the_source():
    files = [file for floor in FLOORS for file in (ROOT / floor).rglob("*.py")]
    source = "\n".join(file.read_text() for file in [*files, ROOT / "Makefile"])
    source = re.sub(r'"\n\s*f?"', "", source)  # joins the parts of strings
    page = (DOCS / "troubleshooting.md").read_text()
    lists = re.findall(r"^- ((?:`[^`]+`(?:,\s+)?)+):", page, re.MULTILINE)
    messages = {message for found in lists for message in re.findall("`([^`]+)`", found)}
    assert FOREIGN_MESSAGES < messages and len(messages) >= 20
    for message in messages - FOREIGN_MESSAGES:
        # Between values, and between the words of `require`.
        for part in re.split(r"\b(?:[A-Z]{2,}|N)\b|must be |, got ", message):
            assert part.strip(" :") in source, message


def test_every_picture_has_its_command():
    images = [image for page in PAGES for image in IMAGE.findall(page.read_text())]
    shown = {f"docs/{Path(image).name}" for image in images if not image.endswith(".svg")}
    made = {words[-1] for words in commands(DOCS / "pictures.md")}
    assert len(shown) > 10
    assert shown <= made


@pytest.mark.parametrize("page", PAGES, ids=[page.stem for page in PAGES])
def test_tables_of_pages_are_those_of_the_results(page):
    assert results.with_tables(page.read_text()) == page.read_text()


def test_figures_show_the_results():
    figures, page = results.figures(), (results.REPORT / "index.md").read_text()
    for name in (draw.__name__ for draw in report_figures.FIGURES):
        written = ElementTree.parse(results.REPORT / f"{name}.svg")
        description = written.findtext(".//{http://purl.org/dc/elements/1.1/}description")
        assert description == report_figures.plotted(figures[name]), name
        assert f"({name}.svg)" in page


def test_the_pdf_is_of_the_page():
    printed = (results.REPORT / "report.pdf").read_bytes()
    assert printed.startswith(b"%PDF") and printed.endswith(results.report_digest())


@pytest.mark.parametrize(
    ("name", "column", "table", "draw"),
    [
        ("ablation", "psnr_db", "columns ablation", report_figures.ablation),
        ("off_path_views", "psnr_db", "columns off_path", report_figures.off_path),
        ("gap", "gap_points", "columns gap", report_figures.gap),
        ("realism", "successes", "realism realism", report_figures.realism),
        (results.STUDY, "successes", "policies study", report_figures.success),
    ],
)
def test_a_changed_number_changes_table_and_figure(
    name, column, table, draw, tmp_path, monkeypatch
):
    def rendered() -> tuple[str, str]:
        monkeypatch.setattr(results.Results, "read", classmethod(cache(read)))
        figure = draw(results.Results.read(report_figures.FIGURES[draw]).rows)
        page = f"<!-- table {table} -->\n<!-- end of table -->"
        return results.with_tables(page), report_figures.plotted(figure)

    read = results.Results.read.__func__.__wrapped__
    before = rendered()
    shutil.copytree(results.RESULTS, tmp_path / "results")
    file = tmp_path / "results" / f"{name}.csv"
    rows = list(csv.DictReader(file.read_text().splitlines()))
    rows[0][column] = f"{float(rows[0][column]) - 1:g}"
    write_csv(file, rows)
    monkeypatch.setattr(results, "RESULTS", tmp_path / "results")
    assert all(old != new for old, new in zip(before, rendered(), strict=True))


@pytest.mark.parametrize("page", [p for p in PAGES if p.stem != "CHANGELOG"], ids=lambda p: p.stem)
def test_success_of_flights_stands_in_tables_of_results_alone(page):
    text = results.TABLE.sub("", page.read_text())
    success = r"\d+/\d+ \(\d+ ?%\)|\d+ of (its )?\d+ (flights|goals)|arrives? in \d+|\d+/\d\d+ at"
    assert not re.findall(success, text)


def test_configurations_of_commands_have_sections_and_their_fields_descriptions():
    page = runpy.run_path(str(DOCS / "_ext" / "configuration_page.py"))
    configurations = [config for _, _, group in page["configurations"]() for config in group]
    for config in configurations:
        if not type(config).__module__.startswith("splatpilot."):
            continue  # Drake's, and those that other tests have registered.
        for field in describe_fields(config):
            said = re.sub(r"\[[^]]*\]", "", field.text).strip()
            assert len(said) > 3, f"{type(config).__name__}.{field.name}: {field.text!r}"
    loaded = set()
    for module in (ROOT / "analysis" / "commands").glob("*.py"):
        loaded |= set(re.findall(r"\b(\w+Config|Scenario)(?:\(\)|\")", module.read_text()))
    assert len(loaded) >= 8
    assert loaded <= {type(config).__name__ for config in configurations}


def test_site_builds(tmp_path):
    command = [sys.executable, "-m", "sphinx", "--fail-on-warning", "--keep-going", "--quiet"]
    done = subprocess.run([*command, DOCS, tmp_path], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    inventory = (tmp_path / "objects.inv").read_bytes().split(b"zlib.\n", 1)[1]
    known = {line.split()[0] for line in zlib.decompress(inventory).decode().splitlines()}
    api = runpy.run_path(str(DOCS / "_ext" / "api_page.py"))
    systems = list(api["leaf_systems"]())
    assert len(systems) > 20
    assert {f"splatpilot.{name}" for name in api["public_names"]()} | set(systems) <= known
    assert "alias of" not in (tmp_path / "api.html").read_text()
    html = (tmp_path / "configuration.html").read_text()
    assert all(f">{field.name}<" in html for field in describe_fields(sp.Scenario()))
    assert "https://" not in re.sub(r'href="[^"]*"', "", (tmp_path / "index.html").read_text())


def test_python_of_the_readme_runs(tmp_path, monkeypatch, registered, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    policy, flight, training = blocks(README, "python")
    for text, small in (
        ("Env(16, scenario, num_worlds=4", "Env(1, scenario, num_worlds=1"),
        ("n_steps=64", "n_steps=2"),
        ("200_000", "2"),
        ("progress_bar=True", "progress_bar=False"),  # which needs rich
    ):
        assert text in training
        training = training.replace(text, small)
    Path("my_policy.py").write_text(policy)
    Path("flight.py").write_text("from my_policy import *\n" + flight)
    Path("training.py").write_text(training)
    runpy.run_path("training.py")
    capsys.readouterr()
    runpy.run_path("flight.py")
    summary = ast.literal_eval(capsys.readouterr().out)
    assert summary["outcome"] in set(sp.Outcome) and summary["path_length_m"] > 1.0
    command = re.search(r"splatpilot (fly --policy my_policy.*)", README.read_text())
    assert command is not None
    assert main([*command[1].split(), "--set", "timeout=1", "--out", "flight"]) == 0


def test_readme_is_two_screens_and_lists_all_extras():
    text = README.read_text()
    assert len(text.splitlines()) <= 150
    (listed,) = re.findall(r"Extras:.*?\n\n", text, re.DOTALL)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = set(project["optional-dependencies"]) - {"dev"}
    assert set(re.findall(r"`(\w+)`", listed)) == extras
