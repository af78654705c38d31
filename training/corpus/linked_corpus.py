"""A corpus made of the files of another, which take no room twice, to add others to."""

import os
import shutil
from pathlib import Path

from splatpilot.systems.files import folder_written_atomically, written_atomically
from splatpilot.training.corpus.corpus import CONFIG, entries

_PARTS = ("worlds", "world.yaml"), ("shards", "shard.json")  # and what tells one from others


def link_corpus(source: Path, folder: Path) -> None:
    """Makes `folder` a corpus of what `source` has, and of what was added to it; what `folder`
    lacks of the former is brought there again.

    Raises:
        ValueError: if it holds others of the same name: what `source` has was gathered anew.
        OSError: if it cannot be written.
    """
    for kind, about in _PARTS:
        for there in entries(source / kind):
            target = folder / kind / there.name
            if not target.exists():
                _link_folder(there, target)
            elif (target / about).read_bytes() != (there / about).read_bytes():
                raise ValueError(
                    f"{there} is another than when {target} was made of it; choose another --out"
                )
    if not (folder / CONFIG).exists():
        _link(source / CONFIG, folder / CONFIG)


def _link_folder(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    with folder_written_atomically(target) as partial_folder:
        for file in source.iterdir():
            _link(file, partial_folder / file.name)


def _link(source: Path, target: Path) -> None:
    try:
        os.link(source, target)
    except OSError:  # on another disk
        with written_atomically(target) as path:
            shutil.copyfile(source, path)
