"""The command line, as a user meets it."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatpilot.analysis import scenes
from splatpilot.analysis.commands.main import main
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.systems.common.config import load_config
from splatpilot.systems.common.progress import resumable
from splatpilot.systems.policies.straight import StraightConfig
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.splats.splat_files import write_ply

SHORT = ["--set", "world.length=10", "--set", "world.width=6", "--set", "timeout=15"]


def test_fly_leaves_what_it_promises(tmp_path, capsys):
    """A short flight succeeds, prints its table, and leaves page, video, trajectory and summary."""
    out = tmp_path / "flight"
    graph = tmp_path / "diagram.dot"
    assert main(["fly", "--out", str(out), "--seed", "2", "--graphviz", str(graph), *SHORT]) == 0

    summary = json.loads((out / "summary.json").read_text())
    assert set(summary) == {
        "outcome",
        "flight_time_s",
        "path_length_m",
        "mean_speed_m_s",
        "min_clearance_m",
        "real_time_factor",
        "render_ms",
    }
    assert summary["outcome"] == "goal"
    assert summary["min_clearance_m"] > 0
    printed = capsys.readouterr().out
    for text in ("outcome", "goal", "minimum clearance", "real-time factor", str(out)):
        assert text in printed

    trajectory = np.load(out / "trajectory.npz")
    assert trajectory["states"].shape == (len(trajectory["times"]), 13)
    assert trajectory["times"][-1] == summary["flight_time_s"]

    video = cv2.VideoCapture(str(out / "flight.mp4"))
    frames = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
    assert frames == int(summary["flight_time_s"] * 15 + 1e-6) + 1
    ok, frame = video.read()
    assert ok
    assert frame.shape == (240, 640, 3)
    assert frame[:, :320].std() > 20  # Not one color: a picture of something,
    assert frame[:, 320:].std() > 20  # and a depth picture beside it.

    page = (out / "flight.html").read_text()
    assert "<html" in page.lower()
    assert "digraph" in graph.read_text()
    assert not [path for path in out.iterdir() if path.name.startswith(".")]


def test_written_scenario_gives_the_same_flight_again(tmp_path):
    """Flying the scenario.yaml that a flight left repeats its trajectory byte for byte."""
    first, second = tmp_path / "first", tmp_path / "second"
    assert main(["fly", "--out", str(first), "--seed", "5", *SHORT, "--set", "timeout=2"]) == 0
    again = ["fly", "--scenario", str(first / "scenario.yaml"), "--out", str(second)]
    assert main(again) == 0
    trajectories = [(folder / "trajectory.npz").read_bytes() for folder in (first, second)]
    assert trajectories[0] == trajectories[1]


@pytest.mark.parametrize(
    ("words", "status"),
    [
        ("--help", 0),
        ("--version", 0),
        ("fly --help", 0),
        ("fly --nonsense", 2),
        ("fly --policy nobody", 1),
        ("fly --policy nobody.npz", 1),
        ("fly --scenario P99", 1),
        ("fly --scene nowhere", 1),
        ("hardware bridge --hardware nowhere.yaml", 1),
        ("benchmark --out study --policies planner,nobody", 1),
        ("benchmark --out study --scenarios P02,nowhere.yaml", 1),
        ("replay nowhere id", 1),
        ("reconstruct nowhere --out scene", 1),
        ("capture check nowhere", 1),
        ("capture render nowhere.gltf --out capture", 1),
        ("scene measure nowhere", 1),
        ("train nobody --out run", 1),
        ("corpus inspect nowhere --out sheet.png", 1),
    ],
)
def test_help_and_what_is_not_there_import_nothing_heavy(words, status, tmp_path):
    """Help and version come at once, and so does the answer to a wrong name or path: no package
    that takes long to load is imported for them, and nothing is written."""
    script = (
        "import sys; from splatpilot.analysis.commands.main import main\n"
        f"try: status = main({words.split()})\n"
        "except SystemExit as ended: status = ended.code\n"
        "print(status, *{name.partition('.')[0] for name in sys.modules})"
    )
    ended = subprocess.run(
        [sys.executable, "-c", script], check=True, capture_output=True, text=True, cwd=tmp_path
    )
    found, *loaded = ended.stdout.splitlines()[-1].split()
    assert int(found) == status
    assert status == 0 or "splatpilot" in ended.stderr.splitlines()[-1]
    assert not list(tmp_path.iterdir())
    loaded = set(loaded)
    assert "splatpilot" in loaded
    assert not loaded & {"numpy", "pydrake", "scipy", "torch", "matplotlib", "cv2", "yaml", "tqdm"}


@pytest.mark.parametrize(
    "words",
    [
        "train diffaero --out run",
        "recover student_rgb --out run",
        "corpus make --out corpus --worlds 2",
        "scene fetch forest_splat --out scenes",
        "reconstruct . --out scene",
        "scene ablate . --out study",
        "scene fidelity . --out study",
        "scene measure .",
        "capture check .",
        "capture render P02 --out capture",
        "benchmark --out study --quick",
    ],
)
def test_long_commands_say_what_they_do_before_anything_slow_is_imported(words, tmp_path):
    (tmp_path / "out" / "corpus" / "shards").mkdir(parents=True)
    script = (
        "import sys; from splatpilot.analysis.commands.main import main\n"
        # Importing these fails.
        "sys.modules |= dict.fromkeys(['numpy', 'pydrake', 'torch', 'yaml'])\n"
        f"main({words.split()})"
    )
    ended = subprocess.run(
        [sys.executable, "-c", script],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env=os.environ | {"TMPDIR": str(tmp_path)},  # of the report
    )
    said, *failure = ended.stderr.splitlines()
    assert said and not said.startswith("splatpilot") and "ing " in said
    assert failure and "\r" not in ended.stderr


def test_version(capsys):
    """`splatpilot --version` prints the installed version."""
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == 0
    assert capsys.readouterr().out == f"splatpilot {version('splatpilot')}\n"


def fails(arguments: list[str], capsys) -> str:
    """The one message with which a command that must fail fails."""
    assert main(arguments) == 1
    error = capsys.readouterr().err
    assert error.startswith("splatpilot: ")
    assert "Traceback" not in error
    return error


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--set", "goal=[100, 0, 2]"], "goal [100.0, 0.0, 2.0] is outside the world"),
        (["--set", "start=[1.5, 0, -1]"], "start [1.5, 0.0, -1.0] is"),
        (["--set", "start=[1.5, 0, 0.2]"], "0.200 m from the nearest surface"),
        (["--set", "camera.focal=!FocalLength {x: 0}"], "camera.focal must be positive"),
        (["--set", "worl.length=3"], "did you mean world"),
        (["--set", "world.spacing=0.5"], "spacing"),
        (["--scenario", "nowhere.yaml"], "No such file or folder: nowhere.yaml"),
        (["--scene", "nowhere"], "nowhere"),
        (["--policy", "nobody"], "there is no policy 'nobody'"),
        (["--policy", "reactive:margin"], "without a value; write reactive:margin=VALUE"),
        (["--scenario", "P99"], "there is no scenario 'P99'"),
        (["--seed", "-1"], "seed"),
        (["--speed", "-2"], "the speed must be in (0, 20] m/s, got -2"),
        (["--policy", "diffaero", "--speed", "15"], "policy.speed must be in [0.1, 10] m/s"),
    ],
)
def test_bad_input_is_one_message_and_nothing_written(arguments, message, tmp_path, capsys):
    """Every user error ends with one message, exit status 1 and an output folder without files."""
    out = tmp_path / "out"
    assert message in fails(["fly", "--out", str(out), *arguments], capsys)
    assert not out.exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("fli", "splatpilot: there is no command 'fli'; did you mean fly?"),
        ("capture chek room", "splatpilot capture: there is no action 'chek'; did you mean check?"),
        ("view P02 --sede 3", "view: unrecognized arguments: --sede 3; did you mean --seed?"),
        ("fly timeout=3", "unrecognized arguments: timeout=3; did you mean --set timeout=3?"),
        ("fly --set timeout", "--set must be FIELD=VALUE, got 'timeout'; see `splatpilot fly --he"),
        ("fly --seed 1.5", "splatpilot fly: --seed must be a whole number, got '1.5'"),
        ("fly --speed fast", "splatpilot fly: --speed must be a number, got 'fast'"),
    ],
)
def test_an_invalid_command_line_is_one_sentence(words, message, capsys):
    with pytest.raises(SystemExit) as ended:
        main(words.split())
    error = capsys.readouterr().err
    assert (ended.value.code, error.count("\n")) == (2, 1)
    assert message in error


def make_scene(xs) -> GaussianScene:
    """Gaussians in a row along x."""
    means = np.array([[x, 0.0, 0.0] for x in xs])
    count = len(means)
    return GaussianScene.from_colors(
        means,
        np.tile([1.0, 0, 0, 0], (count, 1)),
        np.full((count, 3), 0.1),
        np.full(count, 0.9),
        np.full((count, 3), 0.5),
    )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["depthnav", "--seeds", "0", "1", "0"], "the seed 0 is given twice"),
        (["depthnav", "diffaero", "depthnav"], "the policy depthnav is given twice"),
    ],
)
def test_nothing_is_trained_twice(words, message, tmp_path, capsys):
    """Two runs would write to one folder."""
    assert message in fails(["train", *words, "--out", str(tmp_path / "out")], capsys)
    assert not (tmp_path / "out").exists()


def test_scene_of_another_unit_is_refused(tmp_path, capsys):
    """A PLY that spans kilometers is not flown with voxels larger than the vehicle."""
    ply = tmp_path / "millimeters.ply"
    generator = np.random.default_rng(0)
    scene = make_scene(generator.uniform(0, 1, 500))
    means = generator.uniform(0, 2e4, scene.means.shape).astype(np.float32)
    write_ply(dataclasses.replace(scene, means=means), ply)
    error = fails(["fly", "--scene", str(ply), "--out", str(tmp_path / "o")], capsys)
    assert "rescale with `splatpilot scene scale`" in error


def test_foreign_scene_is_refused(tmp_path, capsys):
    """A PLY that is no Gaussian scene, a truncated one, and a folder that is no scene are refused
    by name.
    """
    ply = tmp_path / "mesh.ply"
    ply.write_text("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n")
    assert str(ply) in fails(["fly", "--scene", str(ply), "--out", str(tmp_path / "o")], capsys)
    write_ply(make_scene([1.0, 2.0]), ply)
    ply.write_bytes(ply.read_bytes()[:-20])
    assert str(ply) in fails(["fly", "--scene", str(ply), "--out", str(tmp_path / "o")], capsys)
    ply.write_bytes(b"\x00\x01 this is not a PLY")
    assert str(ply) in fails(["fly", "--scene", str(ply), "--out", str(tmp_path / "o")], capsys)
    folder = tmp_path / "folder"
    folder.mkdir()
    assert "folder" in fails(["fly", "--scene", str(folder), "--out", str(tmp_path / "o")], capsys)


def test_unwritable_output_folder_is_refused_before_flying(tmp_path, capsys):
    """An output folder that cannot be made is named, with the remedy, before anything is flown."""
    (tmp_path / "file").write_text("")
    error = fails(["fly", "--out", str(tmp_path / "file" / "out")], capsys)
    assert "file/out" in error
    assert "--out" in error


def test_reconstruct_without_capture_is_refused(tmp_path, capsys):
    """A capture that is not there is named."""
    missing = str(tmp_path / "capture")
    error = fails(["reconstruct", missing, "--out", str(tmp_path / "scene")], capsys)
    assert missing in error
    assert not (tmp_path / "scene").exists()


@pytest.mark.skipif("SPLATPILOT_DATA" not in os.environ, reason="SPLATPILOT_DATA is not set")
def test_flight_through_a_real_capture(tmp_path):
    """TartanAir's hospital, reconstructed without optimization, is flown for at least 6 m to the
    goal without touching anything.
    """
    capture = Path(os.environ["SPLATPILOT_DATA"]) / "tartanair" / "hospital"
    scene, out = tmp_path / "hospital", tmp_path / "flight"
    assert main(["reconstruct", str(capture), "--out", str(scene), "--iterations", "0"]) == 0
    assert main(["fly", "--scene", str(scene), "--out", str(out)]) == 0
    summary = json.loads((out / "summary.json").read_text())
    assert summary["outcome"] == "goal"
    assert summary["path_length_m"] >= 6.0
    assert summary["min_clearance_m"] > 0.0


def test_fly_by_the_names_of_the_benchmark(tmp_path):
    """`fly` takes a policy by its name, and overrides then set fields of that policy."""
    out = tmp_path / "flight"
    words = ["--policy", "straight", "--set", "policy.speed=1.5", *SHORT, "--set", "timeout=1"]
    assert main(["fly", "--out", str(out), *words]) == 0
    scenario = load_config(Scenario(), out / "scenario.yaml")
    assert scenario.policy == StraightConfig(speed=1.5)
    assert np.load(out / "trajectory.npz")["hypotheses"].shape == (0, 0)


@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_signals_end_with_one_line(number, status, tmp_path):
    """A flight that is ended from outside says so in one line, and leaves no half of anything."""
    out = tmp_path / "flight"
    script = (
        "import signal, sys; from splatpilot.analysis.commands.main import main\n"
        # Shells have what runs in their background ignore it.
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        f"sys.exit(main(['fly', '--out', {str(out)!r}]))"
    )
    flying = subprocess.Popen(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert flying.stdout is not None and flying.stderr is not None
    assert flying.stdout.readline().startswith("Building the world")
    flying.send_signal(number)
    said = flying.stderr.read()
    assert flying.wait(60) == status
    assert said.splitlines()[-1].startswith("splatpilot: ") and "Traceback" not in said
    assert not out.exists() or not list(out.iterdir())


@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_signal_while_something_is_imported(number, status, tmp_path):
    """A signal that comes while native code is imported, which could answer an exception with one
    of its own or by aborting, ends the process without one."""
    (tmp_path / "interrupted.py").write_text(
        "import signal\n"
        "try:\n"
        f"    signal.raise_signal({int(number)})\n"
        "except KeyboardInterrupt:\n"
        "    raise ImportError('a core of it failed to import')\n"
    )
    script = (
        "import signal, sys; from splatpilot.analysis.commands.main import main\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "print('before', flush=False)\n"
        "sys.exit(main(['--import', 'interrupted', 'doctor']))"
    )
    ended = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True
    )
    word = {143: "terminated", 130: "interrupted"}[status]
    assert (ended.returncode, ended.stderr) == (status, f"splatpilot: {word}\n")
    assert ended.stdout == "before\n"


@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_signal_after_the_last_result(number, status):
    """A signal that comes when all is done, but the process is there still, says the same."""
    script = (
        "import signal; from splatpilot.analysis.commands import main as cli\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        f"cli.main = lambda: signal.raise_signal({int(number)})\n"
        "cli.run()"
    )
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    word = {143: "terminated", 130: "interrupted"}[status]
    assert (ended.returncode, ended.stderr) == (status, f"splatpilot: {word}\n")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signal_while_modules_are_taken_apart(number):
    """A signal that comes when Python answers none any more does not make a failure of success."""
    script = (
        "import os, signal, threading, time; from splatpilot.analysis.commands.main import run\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        # What the main thread does not take goes to any other.
        "threading.Thread(target=time.sleep, args=(60,), daemon=True).start()\n"
        "class Late:\n"
        "    def __del__(self, kill=os.kill, process=os.getpid(), sleep=time.sleep):\n"
        f"        kill(process, {int(number)})\n"
        "        sleep(0.1)\n"
        "late = Late()\n"
        "run()"
    )
    words = [sys.executable, "-c", script, "--version"]
    ended = subprocess.run(words, capture_output=True, text=True)
    assert (ended.returncode, ended.stderr) == (0, "")


@pytest.mark.parametrize(
    ("how", "status", "message"),
    [
        (f"signal.raise_signal({int(signal.SIGTERM)})", 143, "terminated"),
        ("raise ValueError('no')", 1, "no (FILE, line 4)"),
    ],
)
def test_what_is_said_stands_below_progress_bars(how, status, message, tmp_path):
    """Neither in the line of a progress bar that nobody has closed, nor above its last state."""
    (tmp_path / "working.py").write_text(
        f"import signal; from tqdm import tqdm\nbar = tqdm(total=3)\nbar.update()\n{how}\n"
    )
    script = (
        "import sys; from splatpilot.analysis.commands.main import main\n"
        "sys.exit(main(['--import', 'working', 'doctor']))"
    )
    words = [sys.executable, "-c", script]
    ended = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True)
    assert ended.returncode == status
    last = ended.stderr.replace("\r", "\n").splitlines()[-1]
    assert last == f"splatpilot: {message}".replace("FILE", str(tmp_path / "working.py"))
    assert "/3" in ended.stderr


def test_an_interruption_says_what_is_kept(tmp_path, capsys, monkeypatch):
    def interrupted(**_keywords):
        with resumable(lambda: "one scene is in scenes; the same command resumes"):
            raise KeyboardInterrupt

    monkeypatch.setattr(scenes, "run", interrupted)
    assert main(["scene", "fetch", "forest_splat", "--out", str(tmp_path)]) == 130
    last = capsys.readouterr().err.splitlines()[-1]
    assert last == "splatpilot: interrupted; one scene is in scenes; the same command resumes"


def test_drake_says_nothing_but_warnings(tmp_path):
    """Pages are written by a Meshcat that nobody is to connect to, so its address is not told."""
    script = (
        "import sys; from splatpilot.analysis.commands.main import main\n"
        f"main(['view', 'nowhere', '--out', {str(tmp_path / 'page.html')!r}])\n"
        "from pydrake.geometry import Meshcat; Meshcat()"
    )
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert ended.returncode == 0
    assert "folder: nowhere" in ended.stderr and "Meshcat" not in ended.stderr
