"""Names and paths that the command line checks before slow imports."""

import subprocess
import sys

import pytest

from splatpilot.analysis.commands.main import main

RENDER = "got a mesh; render a capture of it with `splatpilot capture render room.gltf"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("fly --scene images", "got a capture; make a scene of it with `splatpilot reconstruct im"),
        ("fly --scene room.gltf", RENDER),
        ("fly --scene fast.yaml", "got a scenario; fly it with `splatpilot fly --scenario fast.y"),
        ("view room.gltf", RENDER),
        ("reconstruct scene --out out", "got a scene folder; fly in it with `splatpilot fly --sce"),
        ("scene mesh room.gltf --out out", RENDER),
    ],
)
def test_another_kind_of_file_is_named_with_what_to_do_with_it(
    words, message, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    for name in ("room.gltf", "fast.yaml", "scene/scene.yaml", "images/transforms.json"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("{}")
    assert main(words.split()) == 1
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "corpus"),
    [
        (["train", "student_rgb"], "out/corpus"),
        (["train", "diffaero_rgb", "--set", "corpora=[there, absent]"], "absent"),
        (["recover", "student_depth", "--set", "corpora=[absent]"], "absent"),
    ],
)
def test_a_missing_corpus_is_told_before_torch_is_imported(words, corpus, tmp_path):
    (tmp_path / "there" / "shards").mkdir(parents=True)
    script = (
        "import sys; from splatpilot.analysis.commands.main import main\n"
        f"status = main({[*words, '--out', 'trained']!r})\n"
        "sys.exit(99 if 'torch' in sys.modules else status)"
    )
    command = [sys.executable, "-c", script]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert ended.returncode == 1
    remedy = f"collect one with `splatpilot corpus make --out {corpus} --worlds 18`"
    assert ended.stderr == f"splatpilot: {corpus} holds no corpus; {remedy}\n"
