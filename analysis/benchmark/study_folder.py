"""A study on disk.

    study.yaml       the study, and the program that flies it
    scenarios/       with all fields
    scenes/          reconstructed scenes of the scenarios
    weights/         files of weights of policies, by label, as they are
    rollouts/        trajectory and metrics of each flight
    timings/         times and machine of each flight, which differ between runs of a study
    errors/          traceback of a flight that stopped the study
    rollouts.csv, timings.csv, table.csv, scenarios.csv, pairs.csv, report.html
    external.csv     for scenarios with published results

Files are written atomically; a flight is complete if its file in `rollouts/` exists.
"""

import contextlib
import hashlib
import inspect
import json
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from splatpilot.analysis.benchmark.rollout import ARRAYS, INFEASIBLE, Fault, Rollout
from splatpilot.analysis.benchmark.study import RolloutSpec, StudyConfig
from splatpilot.analysis.benchmark.tables import Row
from splatpilot.analysis.benchmark.variants import LIVE, SCENARIO
from splatpilot.diagrams.flight.policies import POLICIES, weights_file
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.flight.sensors import SENSORS
from splatpilot.diagrams.worlds import scene_folder
from splatpilot.diagrams.worlds.file_worlds import MeshWorld
from splatpilot.diagrams.worlds.scene_folder import SceneSource, find_scene
from splatpilot.diagrams.worlds.splits import find_test_source, part_digests
from splatpilot.diagrams.worlds.world_registry import WORLDS
from splatpilot.systems.common.config import dump_config, load_config, parse_config
from splatpilot.systems.common.files import (
    find_data,
    folder_written_atomically,
    require_writable_folder,
    write_text,
    written_atomically,
)
from splatpilot.systems.common.readers import error_summary, read_archive, read_text, yaml_errors
from splatpilot.systems.common.validation import errors_about, require
from splatpilot.systems.vehicle.vehicles import VEHICLES

FORMAT_VERSION = 1
_SHAPES = {"times": (), "states": (13,), "commands": (4,), "clearances": ()}
"""Shapes of a sample of each array."""
_REQUIRED = {
    *("success", "outcome", "digest", "flight_time_s", "path_length_m", "mean_speed_m_s"),
    *("min_clearance_m", "jerk_m_s3"),
}
"""Columns of all flights that were flown."""
_SCENE_FILES = (
    *(scene_folder.GAUSSIANS, scene_folder.PACKED_GAUSSIANS, scene_folder.ESDF),
    *(scene_folder.FRONTIER, scene_folder.ENVIRONMENT, scene_folder.OBSERVATIONS),
)
"""The files of a scene folder that flights depend on."""
_OWN = "scenarios/"  # before the name of a scenario: label of the weights of its own policy
_KNOWN = {"splatpilot", "__main__"} | sys.stdlib_module_names


@dataclass(frozen=True)
class StudyFolder:
    """The files of a study."""

    path: Path

    def weights(self, label: str, suffix: str = ".npz") -> Path:
        """Returns the file with the weights of a policy."""
        return self.path / "weights" / f"{label}{suffix}"

    def trajectory(self, id: str) -> Path:
        """Returns the file of a flight."""
        return self.path / "rollouts" / f"{id}.npz"

    def begin(self, config: StudyConfig, program: dict[str, str]) -> None:
        """Creates the folder, or checks that its study is the same, or a part of it."""
        require_writable_folder(self.path)
        if (self.path / "study.yaml").is_file():
            begun = _mapping(StudyConfig()) | self._read()["study"]
            for name, value in _mapping(config).items():
                if begun[name] != value and not _is_part(name, begun[name], value):
                    raise ValueError(
                        f"{self.path} holds a study with {name} {begun[name]}, not {value}; choose "
                        "another folder, the same study, or one that has all of it and more"
                    )
        elif any(self.path.iterdir()):
            raise ValueError(f"{self.path} is not empty and holds no study; choose another folder")
        else:
            self.record(config, program)
        for folder in ("scenarios", "scenes", "weights", "rollouts", "timings"):
            require_writable_folder(self.path / folder)
        shutil.rmtree(self.path / "errors", ignore_errors=True)

    def record(self, config: StudyConfig, program: dict[str, str]) -> None:
        """Writes the study, which may have grown, and the program that flies it."""
        described = {"format_version": FORMAT_VERSION, "study": _mapping(config)}
        described |= {"program": program}
        write_text(self.path / "study.yaml", yaml.safe_dump(described, sort_keys=False))

    def config(self) -> StudyConfig:
        """Reads the study."""
        file = self.path / "study.yaml"
        config = parse_config(StudyConfig(), yaml.safe_dump(self._read()["study"]), str(file))
        with errors_about(file):
            config.validate()
        return config

    def program(self) -> dict[str, str]:
        """Reads the program that flies the study."""
        return self._read()["program"]

    def _read(self) -> dict[str, Any]:
        file = self.path / "study.yaml"
        if not file.is_file():
            raise FileNotFoundError(
                f"No such file: {file}; a study is a folder of `splatpilot benchmark`"
            )
        with yaml_errors(str(file)):
            described = yaml.safe_load(read_text(file))
        described = described if isinstance(described, dict) else {}
        what, version = f"format_version of {file}", described.get("format_version")
        remedy = "use the version of the program that made the study"
        require(version == FORMAT_VERSION, what, str(FORMAT_VERSION), version, remedy)
        for name in ("study", "program"):
            value = described.get(name)
            remedy = "restore the file, or fly the study again in another folder"
            require(isinstance(value, dict), f"{name} of {file}", "a mapping", value, remedy)
        return described

    def write(self, rollout: Rollout) -> None:
        """Writes a flight."""
        id = rollout.row["id"]
        write_text(self.path / "timings" / f"{id}.json", json.dumps(rollout.timing))
        with written_atomically(self.trajectory(id)) as path:
            path.write_bytes(rollout.trajectory)

    def write_fault(self, fault: Fault) -> Path:
        """Writes the traceback of a fault, and returns its file."""
        file = self.path / "errors" / f"{fault.id}.txt"
        file.parent.mkdir(exist_ok=True)
        write_text(file, fault.traceback)
        return file

    def read(self, spec: RolloutSpec) -> tuple[Row, dict[str, np.ndarray]]:
        """Reads the row and the arrays of a flight; no arrays if it could not be flown."""
        file = self.trajectory(spec.id)
        try:
            arrays = read_archive(file)
            row = json.loads(str(arrays.pop("row")))
            if row["outcome"] == INFEASIBLE:
                missing = {"success", "reason"} - row.keys()
            else:
                missing, count = _REQUIRED - row.keys(), len(arrays["times"])
                shapes = {name: (count, *shape) for name, shape in _SHAPES.items()}
                missing |= {name for name in ARRAYS if arrays[name].shape != shapes[name]}
            if missing:
                raise ValueError(f"{min(missing)} is missing or invalid")
        except FileNotFoundError:
            raise
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise ValueError(f"{file} is damaged: {error_summary(error)}") from None
        if {name: row.get(name) for name in spec._fields} != spec._asdict():
            raise ValueError(f"{file} is of another flight, {row}")
        return {"id": spec.id} | row, arrays

    def read_timing(self, id: str) -> dict[str, Any]:
        """Reads times and machine of a flight; empty if unknown."""
        try:
            timing = json.loads(read_text(self.path / "timings" / f"{id}.json"))
        except (OSError, ValueError, RecursionError):
            return {}
        return timing if isinstance(timing, dict) else {}


def _mapping(config: StudyConfig) -> dict[str, Any]:
    return yaml.safe_load(dump_config(config))


def _is_part(name: str, begun: Any, value: Any) -> bool:
    """Checks that a study is a part of another, by a field of its configuration."""
    if name == "seeds":
        return begun <= value
    return name in ("scenarios", "policies", "speeds") and all(each in value for each in begun)


def require_test_scenes(scenarios: dict[str, Scenario]) -> None:
    """Checks that a test study flies only in scenes of the test split, or Gaussians of one."""
    for name, scenario in scenarios.items():
        if not isinstance(scenario.world, SceneSource):
            continue
        scene = find_scene(scenario.world)
        if scene.is_dir():
            split = scene_folder.read_scene_metadata(scene).split
        else:
            split = "test" if find_test_source(part_digests([scene.read_bytes()])) else ""
        what = f"split of {scene}, in which {name} flies,"
        require(split == "test", what, "test in a test study", repr(split), "or use --split dev")


def keep_inputs(folder: StudyFolder, config: StudyConfig, scenarios: dict[str, Scenario]) -> None:
    """Copies scenarios, by name, their scenes, and weights into the folder, for replays."""
    for variant in config.variants:
        if variant.weights is not None:
            _keep_weights(folder, variant.weights, variant.label)
    scenes: dict[Path, str] = {}
    for name, scenario in scenarios.items():
        if isinstance(scenario.world, SceneSource):
            if (scene := find_scene(scenario.world)) not in scenes:
                scenes[scene] = _keep_scene(folder, scene)
            scenario = replace(scenario, world=replace(scenario.world, path=scenes[scene]))
        weights = getattr(scenario.policy, "weights", "")
        if config.flies_own_policies and weights:
            kept = _keep_weights(folder, Path(weights), _OWN + name)  # relative to the folder
            scenario = replace(scenario, policy=replace(scenario.policy, weights=kept))
        file, text = folder.path / "scenarios" / f"{name}.yaml", dump_config(scenario)
        if file.is_file() and file.read_text() != text:
            raise ValueError(
                f"{file} differs from the scenario {name} of this program; choose another folder "
                "with --out, or finish the study with the program that started it"
            )
        write_text(file, text)


def _keep_scene(folder: StudyFolder, scene: Path) -> str:
    """Copies a scene into the study, and returns its path there."""
    kept = folder.path / "scenes" / scene.name
    if kept.exists():
        if _digest(_scene_files(kept)) != _digest(_scene_files(scene)):
            raise ValueError(
                f"{scene} differs from {kept}, a scene of the same name; rename it, or choose "
                "another folder with --out"
            )
    elif scene.is_dir():
        with folder_written_atomically(kept) as partial:
            ignored = shutil.ignore_patterns(scene_folder.CAPTURE)
            shutil.copytree(scene, partial, dirs_exist_ok=True, ignore=ignored)
    else:
        with written_atomically(kept) as partial:
            shutil.copyfile(scene, partial)
    return str(kept.relative_to(folder.path))


def _keep_weights(folder: StudyFolder, file: Path, label: str) -> str:
    """Copies weights into the study, and returns their path there."""
    kept = folder.weights(label, file.suffix)
    if kept.is_file() and kept.read_bytes() != file.read_bytes():
        raise ValueError(
            f"{file} has changed since {folder.path} was started; choose another folder with --out"
        )
    if not kept.is_file():
        kept.parent.mkdir(exist_ok=True)
        with written_atomically(kept) as path:
            shutil.copyfile(file, path)
    return str(kept.relative_to(folder.path))


def kept_scenario(folder: StudyFolder, name: str) -> Scenario:
    """Reads a scenario of a study, with scene and weights in the study's folder."""
    file = folder.path / "scenarios" / f"{name}.yaml"
    scenario = load_config(Scenario(), file)
    with errors_about(file):
        scenario.validate()
    if isinstance(scenario.world, SceneSource):
        scenario.world.path = str((folder.path / scenario.world.path).absolute())
    weights = folder.path / str(getattr(scenario.policy, "weights", ""))
    if weights.is_file():
        policy = replace(scenario.policy, weights=str(weights.absolute()))  # pyright: ignore
        scenario = replace(scenario, policy=policy)
    return scenario


def kept_flights(
    folder: StudyFolder, specs: Iterable[RolloutSpec]
) -> Iterator[tuple[RolloutSpec, Scenario]]:
    """Yields flights with their scenario, policy and seed, from the study's folder alone.
    Distributions are not yet drawn, and modules of policies must be imported."""
    config, specs = folder.config(), list(specs)
    overrides = {each.label: each.policy_overrides for each in config.scenario_variants}
    variants, flown = {}, {spec.policy for spec in specs}
    for variant in (each for each in config.variants if each.label in flown):
        module, colon, _ = variant.policy.partition(":")
        if colon and module not in sys.modules:
            raise ValueError(
                f"{folder.path} flies {variant.policy}, whose module is not imported; if you trust "
                f"it, add --import {module} in front of the command"
            )
        if (weights := variant.weights) is not None:
            kept = folder.weights(variant.label, weights.suffix)
            variant = variant.with_weights(kept.absolute())
        variants[variant.label] = variant
    read = cache(partial(kept_scenario, folder))
    for spec in specs:
        scenario, inner = read(spec.scenario), overrides[spec.scenario]
        policy = variants[spec.policy].config(spec.speed, scenario.policy, inner)
        yield spec, replace(scenario, policy=policy, seed=spec.seed)


def input_digests(config: StudyConfig, scenarios: dict[str, Scenario]) -> dict[str, str]:
    """Returns digests of weights and existing scenes and meshes: by "weights of LABEL", "weights of
    LABEL in SCENARIO" and "scene of SCENARIO"."""
    digests = {}
    for name, scenario in scenarios.items():
        for variant in config.variants:
            key = f"weights of {variant.label}"
            if variant.policy == SCENARIO:
                key += f" in {name}"
            if variant.policy != LIVE and key not in digests:
                file = weights_file(variant.config(config.speeds[0], scenario.policy))
                if file is not None:
                    digests[key] = _digest([file])
        with contextlib.suppress(FileNotFoundError):
            if isinstance(scenario.world, SceneSource):
                digests[f"scene of {name}"] = _digest(_scene_files(find_scene(scenario.world)))
            elif isinstance(scenario.world, MeshWorld):
                mesh = find_data(Path(scenario.world.path), "a mesh")
                parts = sorted(each for each in mesh.parent.iterdir() if each.stem == mesh.stem)
                digests[f"scene of {name}"] = _digest(filter(Path.is_file, parts))
    return digests


def _scene_files(scene: Path) -> Iterable[Path]:
    files = [scene / file for file in _SCENE_FILES] if scene.is_dir() else [scene]
    return filter(Path.is_file, files)


def plugin_digests(scenarios: Iterable[Scenario]) -> dict[str, str]:
    """Returns digests of the source of plugin packages that scenarios and their policies use, by
    "source of PACKAGE"."""
    packages = set()
    for scenario in scenarios:
        for registry, config in (
            (POLICIES, scenario.policy),
            (WORLDS, scenario.world),
            (VEHICLES, scenario.vehicle),
            *((SENSORS, sensor) for sensor in scenario.sensors.values()),
        ):
            entry: Any = registry.entry_for(config)
            parts = (getattr(entry, field.name) for field in fields(entry))
            modules = [getattr(part, "__module__", None) for part in (type(config), *parts)]
            packages |= {module.partition(".")[0] for module in modules if module}
    return {f"source of {name}": _source_digest(name) for name in sorted(packages - _KNOWN)}


def source_digest(function: Callable[..., Any], within: tuple[Any, ...] = ()) -> str:
    """Returns a digest of the source of a function or callable object, or else of its name, and of
    the values that it holds as a closure, as defaults, as attributes of its object, or as a
    `functools.partial`; functions that it is `within` are not followed again."""
    code = function if _has_source(function) else type(function)
    held: list[Any] = [*(getattr(function, "__defaults__", None) or ())]
    held += [cell.cell_contents for cell in getattr(function, "__closure__", None) or ()]
    owner = getattr(function, "__self__", None if code is function else function)
    held += [value for _, value in sorted(getattr(owner, "__dict__", {}).items())]
    if isinstance(function, partial):
        held += [function.func, *function.args, *sorted(function.keywords.items())]
    try:
        text = inspect.getsource(code)
    except (OSError, TypeError):
        text = getattr(code, "__qualname__", repr(code))
    parts = [text, *(_described(value, (*within, function)) for value in held)]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


def _described(value: Any, within: tuple[Any, ...]) -> str:
    is_new = _has_source(value) and value not in within
    text = source_digest(value, within) if is_new else repr(value)
    return type(value).__qualname__ if " at 0x" in text else text  # An address is of one process.


def _has_source(value: Any) -> bool:
    return isinstance(value, type) or hasattr(value, "__code__")


def _source_digest(package: str) -> str:
    module = sys.modules[package]
    folders = [Path(folder) for folder in getattr(module, "__path__", ())]
    files = [file for folder in folders for file in sorted(folder.rglob("*.py"))]
    if not folders and (file := getattr(module, "__file__", None)):
        files = [Path(file)]
    return _digest(files)


def _digest(files: Iterable[Path]) -> str:
    parts = (hashlib.sha256(file.read_bytes()).digest() for file in files)
    return hashlib.sha256(b"".join(parts)).hexdigest()[:16]
