"""Scenes to download: measured scenes, packed into a folder that any file server can offer.

`scenes.json` has the license of each scene by name, and the size and digest of its files. These are
in a folder of that name, which is a scene folder too.
"""

import json
import re
import shutil
import urllib.error
import urllib.request
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from hashlib import sha256
from http.client import HTTPException
from pathlib import Path
from urllib.parse import quote

import numpy as np

from splatpilot.analysis.environments import INDEX, Record, read_index
from splatpilot.diagrams.worlds import scene_folder
from splatpilot.diagrams.worlds.scene_folder import ESDF, PACKED_GAUSSIANS, read_scene_metadata
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.common.files import folder_written_atomically, write_text
from splatpilot.systems.common.progress import Progress
from splatpilot.systems.common.readers import read_text
from splatpilot.systems.common.validation import require, unknown
from splatpilot.systems.splats.splat_files import write_splats

LIST = "scenes.json"
_COPIED = scene_folder.FRONTIER, scene_folder.ENVIRONMENT, scene_folder.OBSERVATIONS
_FILES = {"scene.yaml", PACKED_GAUSSIANS, ESDF, *_COPIED}
_STEPS = 1024.0  # per meter; distances are rounded down to them, which halves their file
_TIMEOUT = 30.0  # [s] without an answer
_MAX_LIST = 1 << 24  # [bytes]


@dataclass(frozen=True)
class PackedFile:
    """A file of a scene."""

    bytes: int
    sha256: str


@dataclass(frozen=True)
class PackedScene:
    """A scene in `LIST`."""

    license: str
    files: dict[str, PackedFile]


def pack(*, names: Sequence[str], scenes: Path, out: Path) -> dict[str, PackedScene]:
    """Writes scenes of the index in the folder `scenes` to `out/NAME`, and lists them in `out`.

    Gaussians become SPZ, which rounds them; distances become at most 1 mm smaller.
    """
    records = read_index(scenes)
    for name in names:
        if name not in records:
            raise ValueError(unknown(f"scene in {scenes / INDEX}", name, records))
        license, remedy = records[name].license, "share only what the license allows"
        free = license and not re.search(r"\bnc\b|non-?commercial", license, re.IGNORECASE)
        require(free, f"license of {name}", "a free one", license or "none", remedy)
        require(not records[name].path, name, "a scene folder", "an OctoMap", "share its file")
    file = out / LIST
    listed = _parse_list(read_text(file).encode(), str(file)) if file.exists() else {}
    for name in Progress(names, "packing", unit="scene"):
        record = records[name]
        with folder_written_atomically(out / name, replace=True) as folder:
            _pack(scenes / name, folder, record)
            files = {
                file.name: PackedFile(file.stat().st_size, _digest(file.read_bytes()))
                for file in sorted(folder.iterdir())
            }
        listed[name] = PackedScene(record.license, files)
        content = {each: asdict(scene) for each, scene in sorted(listed.items())}
        write_text(file, json.dumps(content, indent=1))
    return {name: listed[name] for name in names}


def _pack(scene: Path, folder: Path, record: Record) -> None:
    metadata = read_scene_metadata(scene)
    # The capture stays where it is.
    made_of = metadata.provenance.replace(metadata.capture or record.source, record.source)
    made_of += f"; license {record.license}"
    scene_folder.write_scene_metadata(folder, replace(metadata, capture="", provenance=made_of))
    write_splats(scene_folder.read_gaussians(scene), folder / PACKED_GAUSSIANS)
    esdf = Esdf.load(scene / ESDF)
    replace(esdf, distances=np.floor(esdf.distances * _STEPS) / _STEPS).save(folder / ESDF)
    for name in _COPIED:
        if (scene / name).exists():
            shutil.copyfile(scene / name, folder / name)


def get(*, names: Sequence[str], source: str, scenes: Path) -> dict[str, PackedScene]:
    """Copies scenes from `source`, the path or URL of a folder that `pack` wrote, to `scenes/NAME`,
    and checks their digests. A scene that is there already stays."""
    base = source if "://" in source else Path(source).absolute().as_uri()
    listed = _parse_list(_fetch(f"{base}/{LIST}", _MAX_LIST), f"{base}/{LIST}")
    for name in names:
        if name not in listed:
            raise ValueError(unknown(f"scene in {source}", name, listed))
    for name in names:
        packed, target = listed[name], scenes / name
        if target.exists():
            kept = {file: target / file for file in packed.files if (target / file).is_file()}
            digests = {name: _digest(file.read_bytes()) for name, file in kept.items()}
            same = digests == {file: about.sha256 for file, about in packed.files.items()}
            remedy = "choose another --out, or remove it"
            require(same, str(target), f"the scene of {source}", "another one", remedy)
            print(f"{target}: is there already")
            continue
        with folder_written_atomically(target) as folder:
            for file, about in Progress(packed.files.items(), f"getting {name}", unit="file"):
                url = f"{base}/{quote(name)}/{file}"
                content = _fetch(url, about.bytes)
                digest, remedy = _digest(content), "get it again"
                require(digest == about.sha256, f"digest of {url}", about.sha256, digest, remedy)
                (folder / file).write_bytes(content)
            read_scene_metadata(folder)
        print(f"Wrote {target}; license: {packed.license}")
    return {name: listed[name] for name in names}


def _digest(content: bytes) -> str:
    return sha256(content).hexdigest()


def _parse_list(content: bytes, where: str) -> dict[str, PackedScene]:
    try:
        listed = {
            name: PackedScene(
                **scene | {"files": {n: PackedFile(**file) for n, file in scene["files"].items()}}
            )
            for name, scene in json.loads(content).items()
        }
        for name, scene in listed.items():
            # Names become paths.
            if Path(name).name != name or name in ("", ".", "..") or not _FILES >= set(scene.files):
                raise ValueError(f"{name!r} must have files {', '.join(sorted(_FILES))} only")
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise ValueError(f"{where}: not a list of scenes ({error}); pack them again") from None
    return listed


def _fetch(url: str, size: int) -> bytes:
    try:
        with urllib.request.urlopen(url, timeout=_TIMEOUT) as answer:
            content = answer.read(size + 1)
    except (OSError, ValueError, HTTPException) as error:
        reason = getattr(error, "reason", error)
        raise OSError(f"cannot read {url}: {reason}; check --from, and proxy and network") from None
    require(len(content) <= size, f"size of {url}", f"at most {size} bytes", "more", "get it again")
    return content
