"""Nothing is replaced unless told to: verbs with `--overwrite`."""

import pytest

from splatpilot.analysis.commands.main import main

SHORT = ["--set", "world.length=10", "--set", "world.width=6"]


@pytest.mark.parametrize(
    ("words", "there"),
    [
        (["reconstruct", "capture", "--out", "scene"], "scene/views.png"),
        (["scene", "measure", "scene"], "scene/metrics.json"),
        (["view", "scene", "--out", "mine"], "mine"),
        (["view", "P02", "--seed", "3"], "out/view/P02-003.html"),
        (["hardware", "bridge", "--log", "mine", *SHORT], "mine"),
        (["hardware", "vehicle", "--out", "mine", *SHORT], "mine"),
        (["fly", "--graphviz", "mine", *SHORT], "mine"),
        (["corpus", "inspect", "scene", "--out", "mine"], "mine"),
    ],
)
def test_what_is_there_stays(words, there, place, monkeypatch, capsys):
    """A file or folder that a verb would write is refused, with the remedy, and stays as it is."""
    monkeypatch.chdir(place.folder)
    place.scene("scene")
    (place.folder / "capture").mkdir()
    file = place.folder / there
    file.parent.mkdir(parents=True, exist_ok=True)
    if not file.exists():
        file.write_text("mine")
    before = file.read_bytes()
    assert main(words) == 1
    said = "is there already; choose another, or replace it with --overwrite"
    assert said in capsys.readouterr().err
    assert file.read_bytes() == before


def test_told_to_it_is_replaced(place, monkeypatch, capsys):
    """With --overwrite a scene is measured anew, and its page written anew."""
    monkeypatch.chdir(place.folder)
    place.scene("scene")
    for file, words in {
        "scene/metrics.json": ["scene", "measure", "scene"],
        "page.html": ["view", "scene", "--out", "page.html"],
    }.items():
        (place.folder / file).write_text("old")
        assert main([*words, "--overwrite"]) == 0, capsys.readouterr().err
        assert (place.folder / file).read_text() != "old"
