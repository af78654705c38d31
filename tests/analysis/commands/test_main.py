import logging
import os
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
from importlib.metadata import version

import pytest
from pydrake.geometry import Meshcat
from tqdm import tqdm

from splatpilot.analysis import environments
from splatpilot.analysis.commands import main as cli
from splatpilot.analysis.commands.main import main
from splatpilot.analysis.commands.options import Command
from splatpilot.systems.common import registry
from splatpilot.systems.common.progress import resumable
from splatpilot.systems.common.registry import import_modules

MAIN = "import sys; from splatpilot.analysis.commands.main import main, run\n"
INTERRUPTIBLE = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
HEAVY = {"numpy", "pydrake", "scipy", "torch", "matplotlib", "cv2", "yaml", "tqdm"}


def execute(script, cwd=None, words=(), **environment):
    """Runs a script in a process of its own; returns its exit status, output and errors."""
    ended = subprocess.run(
        [sys.executable, "-c", MAIN + script, *words],
        capture_output=True,
        text=True,
        cwd=cwd,
        env=os.environ | environment,
    )
    return ended.returncode, ended.stdout, ended.stderr


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("fli", "splatpilot: there is no command 'fli'; did you mean fly?"),
        ("capture chek room", "capture: there is no subcommand 'chek'; did you mean check?"),
        ("view P02 --sede 3", "view: unrecognized arguments: --sede 3; did you mean --seed?"),
        ("fly timeout=3", "unrecognized arguments: timeout=3; did you mean --set timeout=3?"),
        ("fly --set timeout", "--set must be FIELD=VALUE, got 'timeout'; see `splatpilot fly --he"),
        ("fly --seed 1.5", "splatpilot fly: --seed must be a whole number, got '1.5'"),
        ("fly --speed fast", "splatpilot fly: --speed must be a number, got 'fast'"),
        ("scene scale a --out b --factor 2 --height 1", "not allowed with argument"),
    ],
)
def test_an_invalid_command_line_has_status_2_and_one_sentence(words, message, capsys):
    with pytest.raises(SystemExit) as ended:
        main(words.split())
    error = capsys.readouterr().err
    assert (ended.value.code, error.count("\n")) == (2, 1)
    assert message in error


RENDER = (
    "got a mesh; fly in it with `splatpilot fly --set 'world=!MeshWorld {path: room.gltf}'`, or"
)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("fly --set goal=[100,0,2]", "goal [100.0, 0.0, 2.0] is outside the world"),
        ("fly --set start=[1.5,0,0.2]", "0.200 m from the nearest surface"),
        ("fly --set 'camera.focal=!FocalLength {x: 0}'", "camera.focal must be positive"),
        ("fly --scenario nowhere.yaml", "No such file or folder: nowhere.yaml"),
        ("fly --scene images", "got a folder without scene.yaml; of a capture, make a scene of"),
        ("scene measure folder", "must be a scene folder, got a folder without scene.yaml"),
        ("gap nowhere", "No such file or folder: nowhere; expected a scene, here or in scenes"),
        ("replay folder a b --video", "2 flights must be without options, got --video; name one"),
        ("library make hospital --split train", "the split of hospital must be train, got test"),
        ("fly --scene room.gltf", RENDER),
        ("fly --scene damaged.ply", "damaged.ply"),
        ("fly --policy reactive:margin", "without a value; write reactive:margin=VALUE"),
        ("fly --seed -1", "seed"),
        ("fly --policy diffaero --speed 15", "policy.speed must be in [0.1, 10] m/s"),
        ("fly --out fast.yaml/out", "cannot write to the output folder fast.yaml/out"),
        ("view room.ksplat", "room.ksplat: a KSPLAT; convert it to PLY"),
        ("view scene --seed 1", "--seed must be of a generated world"),
        ("view scene --set world.length=3", "--set must be of a scenario or a capture"),
        ("view fast.yaml --out fast.yaml", "fast.yaml is there already; choose another --out"),
        ("fly --graphviz fast.yaml", "fast.yaml is there already"),
        ("hardware vehicle --out scene", "scene is there already"),
        ("hardware bridge --log fast.yaml", "fast.yaml is there already"),
        ("corpus inspect folder --out fast.yaml", "fast.yaml is there already"),
        ("corpus export folder --out fast.yaml", "fast.yaml is there already"),
        ("scene mesh P02 --out a.stl", "a.stl: suffix must be .gltf or .obj, got .stl"),
        ("fly --policy teleop", "--policy teleop must be flown with --live"),
        ("fly --draw axes", "--draw must be left out without --live, got axes"),
        ("fly --rerun fast.yaml", "fast.yaml is there already"),
        ("reconstruct nowhere --out a", "No such file or folder: nowhere"),
        ("reconstruct folder --out a", "unknown capture format; known are TartanAir V1"),
        ("reconstruct images --out images", "must be new, empty or a scene"),
        ("scene ablate images --out a --set hold_out=0", "hold_out must be not 0"),
        ("scene ablate images --out a --set hold_out=1", "hold_out must be 0 or"),
        ("scene ablate images --out a --set iterations=0", "iterations must be not 0"),
        ("reconstruct scene --out a", "got a scene folder; fly in it with `splatpilot fly --sce"),
        ("reconstruct images --out a --up z", "--up must be of a mesh or a scenario"),
        ("capture render P02 --out a --path 1,b,2", "--path must be points X,Y,Z"),
        ("benchmark --out a --speeds fast", "--speeds must be numbers in m/s, got 'fast'"),
        ("benchmark --out a --scenarios P02 --jobs 0", "--jobs must be at least 1, got 0"),
        ("replay folder id", "No such file: folder/study.yaml"),
        ("difficulty P10 --seeds 0", "--seeds must be at least 1, got 0"),
        ("train depthnav --out a --seeds 0 1 0", "the seed 0 is given twice"),
        ("train depthnav diffaero depthnav --out a", "the policy depthnav is given twice"),
        ("train student_rgb --out a", "out/corpus holds no corpus; collect one with `splatpilot "),
        ("recover student_depth --out a --set corpora=[b]", "b holds no corpus"),
        ("corpus inspect folder --out a.jpg", "--out must be a PNG file"),
        ("corpus inspect folder --out a.png --samples 0", "--samples must be at least 1, got 0"),
    ],
)
def test_an_error_has_status_1_and_one_sentence_and_writes_nothing(
    words, message, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("SPLATPILOT_DATA", raising=False)
    (tmp_path / "folder").mkdir()
    for name in ("room.gltf", "fast.yaml", "scene/scene.yaml", "images/transforms.json"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("{}")
    (tmp_path / "room.ksplat").write_bytes(bytes(64))
    (tmp_path / "damaged.ply").write_bytes(b"\x00\x01 this is not a PLY")
    before = {path: path.is_file() and path.read_bytes() for path in tmp_path.rglob("*")}
    assert main(shlex.split(words)) == 1
    *_, error = capsys.readouterr().err.splitlines()
    assert error.startswith("splatpilot: ") and message in error
    assert {path: path.is_file() and path.read_bytes() for path in tmp_path.rglob("*")} == before


LIGHT = {
    "--help": 0,
    "--version": 0,
    "fly --help": 0,
    "fly --nonsense": 2,
    "fly --policy missing": 1,
    "fly --scene nowhere": 1,
    "benchmark --out study --policies planner,missing": 1,
    "replay nowhere id": 1,
    "reconstruct nowhere --out scene": 1,
    "train missing --out run": 1,
    "corpus inspect nowhere --out samples.png": 1,
}


def test_help_and_refusals_import_nothing_heavy_and_no_other_commands(tmp_path):
    script = (
        "import contextlib, io\n"
        "def execute(words):\n"
        "    try: return main(words.split())\n"
        "    except SystemExit as ended: return ended.code\n"
        f"for words, status in {LIGHT}.items():\n"
        "    with contextlib.redirect_stderr(io.StringIO()) as err: found = execute(words)\n"
        "    assert found == status and (not status or 'splatpilot' in err.getvalue()), words\n"
        f"    heavy = {HEAVY} & {{name.partition('.')[0] for name in sys.modules}}\n"
        "    assert not heavy, (words, heavy)\n"
        "    if words == 'fly --help':\n"
        "        print(*(n.partition('.commands.')[2] for n in sys.modules))"
    )
    status, out, err = execute(script, tmp_path)
    assert (status, err) == (0, "")
    assert set(out.splitlines()[-1].split()) == {"main", "options", "checks", "flight"}
    assert not list(tmp_path.iterdir())


LONG = [
    "train diffaero --out run",
    "recover student_rgb --out run",
    "corpus make --out corpus --worlds 2",
    "library make forest_splat --out scenes",
    "reconstruct . --out scene",
    "scene ablate . --out study",
    "scene fidelity scene --out study",
    "scene measure scene",
    "capture check .",
    "capture render P02 --out capture",
    "benchmark --out study --quick",
]


def test_long_commands_announce_themselves_before_slow_imports(tmp_path):
    (tmp_path / "out" / "corpus" / "shards").mkdir(parents=True)
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene/scene.yaml").touch()
    script = (
        "sys.modules |= dict.fromkeys(['numpy', 'pydrake', 'torch', 'yaml'])\n"  # import errors
        f"for words in {LONG}:\n"
        "    print('>', words, file=sys.stderr)\n"
        "    main(words.split())"
    )
    _, _, err = execute(script, tmp_path, TMPDIR=str(tmp_path))
    parts = [part.splitlines() for part in err.split("> ")[1:]]
    assert [part[0] for part in parts] == LONG
    for words, announced, *failure in parts:
        assert not announced.startswith("splatpilot") and "ing " in announced, words
        assert failure and "\r" not in err


def test_version():
    module = [sys.executable, "-m", "splatpilot", "--version"]
    printed = subprocess.run(module, capture_output=True, text=True, check=True).stdout
    assert printed == f"splatpilot {version('splatpilot')}\n"


def test_a_signal_during_a_flight_ends_with_one_line_and_no_output(tmp_path):
    script = MAIN + "sys.exit(main(['fly', '--out', 'flight']))"
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    flying = subprocess.Popen([sys.executable, "-c", script], cwd=tmp_path, **streams)
    assert flying.stdout is not None
    assert flying.stdout.readline().startswith("Building the world")
    flying.send_signal(signal.SIGTERM)
    _, error = flying.communicate(timeout=60)
    assert flying.returncode == 143 and "Traceback" not in error
    assert error.splitlines()[-1] == "splatpilot: terminated"
    assert not list(tmp_path.rglob("flight/*"))


@pytest.mark.parametrize(
    ("number", "status", "word"),
    [(signal.SIGTERM, 143, "terminated"), (signal.SIGINT, 130, "interrupted")],
)
def test_a_signal_during_an_import_or_after_the_end_ends_at_once(number, status, word, tmp_path):
    (tmp_path / "interrupted.py").write_text(
        "import signal\nfrom tqdm import tqdm\nbar = tqdm(total=3)\nbar.update()\n"
        f"try:\n    signal.raise_signal({int(number)})\n"
        "except KeyboardInterrupt:\n    raise ImportError('a core of it failed to import')\n"
    )
    script = "print('before', flush=False)\nsys.exit(main(['--import', 'interrupted', 'doctor']))"
    *ended, error = execute(INTERRUPTIBLE + script, tmp_path)
    assert ended == [status, "before\n"]
    # Below the progress bar.
    assert "/3" in error and error.endswith(f"\nsplatpilot: {word}\n")
    script = (
        "from splatpilot.analysis.commands import main as cli\nprint('before')\n"
        f"cli.main = lambda: signal.raise_signal({int(number)})\nrun()"
    )
    ended = execute(INTERRUPTIBLE + script, tmp_path)
    assert ended == (status, "before\n", f"splatpilot: {word}\n")


def test_commands_run_in_a_locale_other_than_utf_8(tmp_path):
    locale = tmp_path / "de_DE.ISO-8859-1"
    if shutil.which("localedef"):
        subprocess.run(["localedef", "-i", "de_DE", "-f", "ISO-8859-1", locale], check=False)
    if not locale.exists():
        pytest.skip("the locale cannot be made here")
    words = ["fly", "--set", "world.spacing=abc"]
    ended = execute("run()", tmp_path, words, LOCPATH=str(tmp_path), LC_ALL=locale.name)
    assert ended[0] == 1 and "must be a number" in ended[2]


def test_a_signal_while_modules_are_unloaded_is_ignored():
    script = (
        INTERRUPTIBLE + "import os, threading, time\n"
        # Signals that the main thread does not take go to any other.
        "threading.Thread(target=time.sleep, args=(60,), daemon=True).start()\n"
        "class Late:\n"
        "    def __del__(self, kill=os.kill, process=os.getpid(), sleep=time.sleep):\n"
        f"        kill(process, {int(signal.SIGTERM)})\n"
        "        sleep(0.1)\n"
        "late = Late()\n"
        "run()"
    )
    status, _, error = execute(script, words=["--version"])
    assert (status, error) == (0, "")


def test_an_interruption_names_the_kept_files(tmp_path, capsys, monkeypatch):
    def interrupted(**_keywords):
        with resumable(lambda: "one scene is in scenes; the same command resumes"):
            raise KeyboardInterrupt

    monkeypatch.setattr(environments, "make", interrupted)
    assert main(["library", "make", "forest_splat", "--out", str(tmp_path)]) == 130
    last = capsys.readouterr().err.splitlines()[-1]
    assert last == "splatpilot: interrupted; one scene is in scenes; the same command resumes"


def test_drake_prints_only_warnings(caplog):
    main(["view", "nowhere"])
    drake = logging.getLogger("drake")
    drake.setLevel(logging.INFO)
    Meshcat()  # prints its address
    drake.warning("a warning")
    assert [each.message for each in caplog.records if each.name == "drake"] == ["a warning"]


@pytest.fixture
def failing(monkeypatch, tmp_path):
    """Makes `splatpilot fly` raise, without plugins of other tests."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(registry, "_plugins", set())

    def fail(error: BaseException) -> int:
        def raise_error(options):
            raise error

        command = Command("fly", ("fly",), (), raise_error)
        monkeypatch.setattr(cli, "find_command", lambda name: command)
        return main(["fly"])

    return fail


def test_an_internal_error_writes_a_report(failing, tmp_path, capsys):
    assert failing(KeyError("of our own")) == 70
    [report] = tmp_path.iterdir()
    error = capsys.readouterr().err
    assert error == f"splatpilot: internal error in fly (KeyError); the report is {report}\n"
    text = report.read_text()
    assert ": fly\n" in text and "Traceback" in text and "of our own" in text


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (MemoryError("Unable to allocate 9 TiB"), r"more memory than there is (Unable to allocate"),
        (MemoryError(), "needs more memory than there is; make"),
        (OverflowError("too large for C long"), "a number given to fly is too large (too large"),
        (ValueError("first\n  second"), "splatpilot: first second"),
        (BrokenPipeError(), "was not read to the end"),
        (KeyboardInterrupt(), "splatpilot: interrupted"),
    ],
)
def test_errors_of_use_and_memory_are_one_line_without_a_report(
    failing, error, message, tmp_path, capsys
):
    with tqdm(total=3) as bar:
        bar.update()
        assert failing(error) in (1, 130)
    _, _, error = capsys.readouterr().err.rpartition("\r")
    assert message in error and error.count("\n") == 2  # one ends the progress bar
    assert not list(tmp_path.iterdir())


def test_errors_of_plugins_name_their_file_and_line(failing, tmp_path, monkeypatch, capsys):
    (tmp_path / "faulty").mkdir()
    file = tmp_path / "faulty" / "parts.py"
    file.write_text(
        "import json, numpy as np\ndef parse():\n    json.loads(3)\n"
        "def add():\n    np.ones(3) + np.ones(2)\n"
    )
    file.with_name("__init__.py").write_text("from faulty.parts import parse, add\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    import_modules(["faulty"])
    for function, message in (
        ("parse", f"{file}, line 3: TypeError: the JSON object"),
        ("add", f"operands could not be broadcast together with shapes (3,) (2,) ({file}, line 5)"),
    ):
        with pytest.raises((TypeError, ValueError)) as raised:
            getattr(sys.modules["faulty"], function)()
        assert failing(raised.value) == 1
        assert message in capsys.readouterr().err
    assert failing(KeyError("of our own")) == 70
