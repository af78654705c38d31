"""`splatpilot merge`: joins the shards of a study into the study."""

import filecmp
import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any

from splatpilot.analysis.benchmark.run_study import Row, conclude, flights_there
from splatpilot.analysis.benchmark.shard import Shard
from splatpilot.analysis.benchmark.study_folder import StudyFolder
from splatpilot.systems.common.files import holds_folder, written_atomically


@holds_folder("out")
def run(*, out: Path, shards: list[Path]) -> list[Row]:
    """
    Joins the folders of all shards of a study. What is left in `out` is the study as if it had been
    flown whole: the same bytes in all files but those of the timings.

    Args:
        out: folder of the study.
        shards: the folders that `splatpilot benchmark --shard` has left, in any order.

    Returns:
        The rows of `table.csv`.

    Raises:
        FileNotFoundError: if a folder is no study, or nothing was flown.
        ValueError: if one is no shard, of another study or program, given twice, missing, not
            flown to its end or damaged; or if `out` holds something else.
        OSError: if `out` cannot be written.
    """
    parts = _by_number([StudyFolder(path) for path in shards])
    first = next(iter(parts.values()))
    config, program = first.config(), first.program()
    files = (file for part in parts.values() for file in part.path.glob("scenarios/[!.]*.yaml"))
    flown = {file.stem for file in files}
    if not flown:
        raise FileNotFoundError("nothing was flown: no shard had the scene of any scenario")
    rows: dict[str, Row] = {}
    for number, part in parts.items():
        rows |= _rows_of(part, Shard(number, len(parts)), flown)
    folder = StudyFolder(out)
    folder.claim(config, program)
    for part in parts.values():
        for kind in ("scenarios", "scenes", "weights", "rollouts", "timings"):
            _copy(part.path / kind, out / kind)
    specs = [spec for spec in config.rollouts() if spec.scenario in flown]
    absent = {
        spec.scenario: "no shard had its scene"
        for spec in config.rollouts()
        if spec.scenario not in flown
    }
    return conclude(folder, config, [rows[spec.id] for spec in specs], absent, [])


def _by_number(folders: list[StudyFolder]) -> dict[int, StudyFolder]:
    """The shards of one study by their numbers, all of them."""
    first, expected = folders[0], _described(folders[0])
    parts: dict[int, StudyFolder] = {}
    total = 0
    for folder in folders:
        for name, value in _described(folder).items():
            if value != expected[name]:
                raise ValueError(
                    f"{folder.path} is a shard of another study than {first.path}: its {name} is "
                    f"{value}, not {expected[name]}"
                )
        shard = folder.shard()
        if shard is None:
            raise ValueError(f"{folder.path} is a study flown whole and no shard of one")
        if shard.number in parts:
            raise ValueError(
                f"{parts[shard.number].path} and {folder.path} are both shard {shard}; give one"
            )
        parts[shard.number], total = folder, shard.total
    missing = [str(number) for number in range(1, total + 1) if number not in parts]
    if missing:
        raise ValueError(
            f"of {total} shards {', '.join(missing)} {'is' if len(missing) == 1 else 'are'} "
            "missing; fly them with --shard, or name their folders too"
        )
    return parts


def _described(folder: StudyFolder) -> dict[str, Any]:
    """What all shards of a study have in common."""
    shard = folder.shard()
    total = None if shard is None else shard.total
    return asdict(folder.config()) | folder.program() | {"number of shards": total}


def _rows_of(folder: StudyFolder, shard: Shard, flown: set[str]) -> dict[str, Row]:
    """The rows of a shard's flights by id; all those in scenarios that any shard has `flown`."""
    specs = [spec for spec in shard.of(folder.config().rollouts()) if spec.scenario in flown]
    rows, damaged = flights_there(folder, specs)
    lacking = [spec.id for spec in specs if spec.id not in rows]
    if lacking:
        raise ValueError(
            f"{folder.path}, shard {shard}, lacks {len(lacking)} of its {len(specs)} flights, "
            f"{lacking[0]} for one{''.join(f'; {problem}' for problem in damaged[:1])}; run its "
            "command again, where all scenes are"
        )
    return rows


def _copy(source: Path, target: Path) -> None:
    """Copies the files of a folder, each whole; those that are there already must be equal."""
    for file in sorted(path for path in source.rglob("*") if path.is_file()):
        copy = target / file.relative_to(source)
        if any(part.startswith(".") for part in file.relative_to(source).parts):
            continue  # What a kill has left of a file that was being written.
        if copy.is_file():
            if not filecmp.cmp(file, copy, shallow=False):
                raise ValueError(
                    f"{file} and {copy} differ, but all shards fly with the same; fly one of the "
                    "shards again with what the other had"
                )
            continue
        copy.parent.mkdir(parents=True, exist_ok=True)
        with written_atomically(copy) as path:
            shutil.copyfile(file, path)
