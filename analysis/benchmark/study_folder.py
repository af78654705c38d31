"""A study on disk.

    study.yaml       what is flown, and the program that flies it; of a shard, which it is
    scenarios/       the scenarios, every field written out
    scenes/          the reconstructed scenes they fly in
    weights/         of policies that were given as files, by their labels
    rollouts/        a trajectory and its measures for each flight
    timings/         how long each took, and where: all that differs between two runs of a study
    errors/          the traceback of a flight that stopped the study
    rollouts.csv, timings.csv, table.csv, report.html
    external.csv     where others published figures about the scenarios

A flight is there when its file in `rollouts/` is; files appear whole.
"""

import csv
import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from splatpilot.analysis.benchmark.rollout import ARRAYS, INFEASIBLE, Fault, Rollout
from splatpilot.analysis.benchmark.shard import Shard
from splatpilot.analysis.benchmark.study import RolloutSpec, StudyConfig
from splatpilot.systems.array_files import read_archive, reason_of
from splatpilot.systems.configuration import dump_config, parse_config
from splatpilot.systems.files import require_writable_folder, written_atomically
from splatpilot.systems.read_limit import read_text, require_shallow

FORMAT_VERSION = 1


_SHAPES = {"times": (), "states": (13,), "commands": (4,), "clearances": ()}
"""Of a sample of the arrays that are kept."""

_MEASURES = "flight_time_s", "path_length_m", "mean_speed_m_s", "min_clearance_m", "jerk_m_s3"


@dataclass(frozen=True)
class StudyFolder:
    """The files of a study."""

    path: Path

    def weights(self, label: str) -> Path:
        """The file that holds the weights of a policy that was given as a file."""
        return self.path / "weights" / f"{label}.npz"

    def trajectory(self, id: str) -> Path:
        """The file that holds a flight."""
        return self.path / "rollouts" / f"{id}.npz"

    def claim(
        self, config: StudyConfig, program: dict[str, str], shard: Shard | None = None
    ) -> None:
        """
        Makes the folder, or checks that the one there is of the same study.

        Args:
            config: what is flown.
            program: `provenance.program()` and `foreign_code`.
            shard: which part of the study is flown here; all of it by default.

        Raises:
            ValueError: if another study, or something else, is there.
            OSError: if the folder cannot be written.
        """
        described = {
            "format_version": FORMAT_VERSION,
            "study": yaml.safe_load(dump_config(config)),
            "program": program,
        }
        if shard is not None:
            described["shard"] = str(shard)
        if (self.path / "study.yaml").is_file():
            self._check_same(described)
        else:
            require_writable_folder(self.path)
            if any(self.path.iterdir()):
                raise ValueError(
                    f"{self.path} is not empty and holds no study; choose another folder"
                )
            # Before all else: it makes the folder that of this study.
            self._describe(described)
        require_writable_folder(self.path)
        for folder in ("scenarios", "scenes", "weights", "rollouts", "timings"):
            require_writable_folder(self.path / folder)
        shutil.rmtree(self.path / "errors", ignore_errors=True)

    def keep_program(self, program: dict[str, str]) -> None:
        """States another program than `claim` was told of, in a folder without flights, or what
        else it consists of."""
        if self.program() != program:
            self._describe(self._described() | {"program": program})

    def _describe(self, described: dict[str, Any]) -> None:
        with written_atomically(self.path / "study.yaml") as path:
            path.write_text(yaml.safe_dump(described, sort_keys=False))

    def _check_same(self, described: dict[str, Any]) -> None:
        there = self._described()
        begun = yaml.safe_load(dump_config(StudyConfig())) | there["study"]
        for name, value in described["study"].items():
            if begun[name] != value:
                raise ValueError(
                    f"{self.path} holds a study with {name} {begun[name]}, not {value}; choose "
                    "another folder, or ask for the same study"
                )
        parts = [f"shard {d['shard']}" if "shard" in d else "all" for d in (there, described)]
        if parts[0] != parts[1]:
            raise ValueError(
                f"{self.path} holds {parts[0]} of this study, not {parts[1]}; choose another folder"
            )

    def _described(self) -> dict[str, Any]:
        file = self.path / "study.yaml"
        if not file.is_file():
            raise FileNotFoundError(
                f"{file}: there is no such file; a study is a folder that `splatpilot benchmark` "
                "has written"
            )
        text = read_text(file)
        require_shallow(text, str(file))
        try:
            described = yaml.safe_load(text)
            version = described["format_version"]
        except (yaml.YAMLError, KeyError, TypeError, RecursionError) as error:
            raise ValueError(f"{file} describes no study: {reason_of(error)}") from None
        if version != FORMAT_VERSION:
            raise ValueError(
                f"{file}: format version {version}, this program knows {FORMAT_VERSION}; use the "
                "version of the program that made the study"
            )
        for name, kind in (("study", dict), ("program", dict), ("shard", str | None)):
            if not isinstance(described.get(name), kind):
                raise ValueError(
                    f"{file} describes no study: {name} is {described.get(name)!r:.80}; restore "
                    "the file, or fly the study anew in another folder"
                )
        return described

    def config(self) -> StudyConfig:
        """What is flown.

        Raises:
            FileNotFoundError, ValueError: if the folder holds no study.
        """
        file = self.path / "study.yaml"
        text = yaml.safe_dump(self._described()["study"])
        config = parse_config(StudyConfig(), text, str(file))
        try:
            config.validate()
        except ValueError as error:
            raise ValueError(f"{file}: {error}") from None
        return config

    def program(self) -> dict[str, str]:
        """What `claim` or `keep_program` was told of the program."""
        return self._described()["program"]

    def shard(self) -> Shard | None:
        """Which part of the study is flown here; None for all of it."""
        text = self._described().get("shard")
        return None if text is None else Shard.parse(text)

    def write(self, rollout: Rollout) -> None:
        """Keeps a flight."""
        id = rollout.row["id"]
        with written_atomically(self.path / "timings" / f"{id}.json") as path:
            path.write_text(json.dumps(rollout.timing))
        with written_atomically(self.trajectory(id)) as path:
            path.write_bytes(rollout.trajectory)

    def write_fault(self, fault: Fault) -> Path:
        """Keeps the traceback of a fault; returns its file."""
        file = self.path / "errors" / f"{fault.id}.txt"
        file.parent.mkdir(exist_ok=True)
        with written_atomically(file) as path:
            path.write_text(fault.traceback)
        return file

    def read(self, spec: RolloutSpec) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """
        The row and the arrays of a flight; no arrays of one that could not be flown.

        Raises:
            FileNotFoundError: if it is not there.
            ValueError: if its file is damaged or of another flight.
        """
        file = self.trajectory(spec.id)
        try:
            arrays = read_archive(file)
            row = json.loads(str(arrays["row"]))
            flown = {name: arrays[name] for name in ARRAYS if name in arrays}
        except FileNotFoundError:
            raise
        except (OSError, ValueError, KeyError, RecursionError) as error:
            raise ValueError(f"{file} is damaged: {reason_of(error)}") from None
        if not isinstance(row, dict):
            raise ValueError(f"{file} is damaged: its row is {row!r:.80}")
        _check_flight(file, row, flown)
        if {name: row.get(name) for name in spec._fields} != spec._asdict():
            raise ValueError(f"{file} is of another flight, {row}")
        return {"id": spec.id} | row, flown

    def read_timing(self, id: str) -> dict[str, Any]:
        """How long a flight took; empty where that is not known."""
        try:
            timing = json.loads(read_text(self.path / "timings" / f"{id}.json"))
        except (OSError, ValueError, RecursionError):
            return {}
        return timing if isinstance(timing, dict) else {}

    def write_table(self, name: str, rows: list[dict[str, Any]]) -> None:
        """Writes rows as CSV, with the columns of all of them."""
        columns = list(dict.fromkeys(column for row in rows for column in row))
        with (
            written_atomically(self.path / name) as path,
            path.open("w", newline="") as file,
        ):
            writer = csv.DictWriter(file, columns, lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)


def _check_flight(file: Path, row: dict[str, Any], flown: dict[str, np.ndarray]) -> None:
    """Raises ValueError unless this is all that is kept of a flight."""
    names = ("reason",) if row.get("outcome") == INFEASIBLE else ("outcome", "digest")
    wrong = [name for name in names if not isinstance(row.get(name), str)]
    if not isinstance(row.get("success"), bool):
        wrong.append("success")
    if row.get("outcome") != INFEASIBLE:
        count = flown["times"].shape[:1] if "times" in flown else ()
        wrong += [name for name in _MEASURES if type(row.get(name)) not in (int, float)]
        wrong += [
            name
            for name, shape in _SHAPES.items()
            if name not in flown
            or flown[name].dtype.kind != "f"
            or flown[name].shape != (*count, *shape)
            or not flown[name].size
            or not (name == "clearances" or np.isfinite(flown[name]).all())
        ]
    if wrong:
        raise ValueError(f"{file} is damaged: {wrong[0]} is missing or of another kind")
