"""What the flights of a study depend on, kept in its folder: scenarios, scenes and weights."""

import hashlib
import shutil
import sys
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

from splatpilot.analysis.benchmark.study import RolloutSpec, StudyConfig
from splatpilot.analysis.benchmark.study_folder import StudyFolder
from splatpilot.analysis.benchmark.variants import SCENARIO
from splatpilot.diagrams.policies import weights_file
from splatpilot.diagrams.scenario import Scenario
from splatpilot.diagrams.worlds.scene import SceneSource, find_scene
from splatpilot.diagrams.worlds.scene_metadata import ENVIRONMENT, FRONTIER, read_scene_metadata
from splatpilot.diagrams.worlds.splits import find_test_source, part_digests
from splatpilot.systems.configuration import dump_config, load_config
from splatpilot.systems.files import folder_written_atomically, written_atomically

_FLOWN_FILES = "gaussians.ply", "esdf.npz", FRONTIER, ENVIRONMENT
"""The files of a scene folder that decide flights."""


def require_test_scenes(scenarios: dict[str, Scenario]) -> None:
    """
    Checks that a test study flies only in scenes from which nothing may be learned.

    Raises:
        ValueError: for a scene of another split; an OctoMap or a file of Gaussians has none.
    """
    for name, scenario in scenarios.items():
        if not isinstance(scenario.world, SceneSource):
            continue
        scene = find_scene(scenario.world)
        if scene.is_dir():
            split = read_scene_metadata(scene).split
        else:
            split = "test" if find_test_source(part_digests([scene.read_bytes()])) else ""
        if split != "test":
            raise ValueError(
                f"split of {scene}, in which {name} flies, must be test in a test study, got "
                f"{split!r}; fly it with --split dev"
            )


def keep_inputs(folder: StudyFolder, config: StudyConfig, scenarios: dict[str, Scenario]) -> None:
    """
    Keeps what flights depend on, so that the folder alone gives them again.

    Args:
        folder: of the study.
        config: what is flown.
        scenarios: by name, those that can be flown here.

    Raises:
        ValueError: if something else is kept there already.
        OSError: if it cannot be read or written.
    """
    for variant in config.variants:
        if variant.weights is not None:
            _keep_weights(folder, variant.weights, variant.label)
    for name, scenario in scenarios.items():
        if isinstance(scenario.world, SceneSource):
            world = replace(scenario.world, path=_keep_scene(folder, scenario.world))
            scenario = replace(scenario, world=world)
        weights = getattr(scenario.policy, "weights", "")
        if config.flies_own_policies and weights:
            kept = _keep_weights(folder, Path(weights), _own(name))
            scenario = replace(scenario, policy=replace(scenario.policy, weights=kept))
        _keep_scenario(folder, name, scenario)


def input_digests(config: StudyConfig, scenarios: dict[str, Scenario]) -> dict[str, str]:
    """
    Returns digests of the weights and scenes that a study flies with, beside
    `provenance.program()`: by "weights of LABEL", for a scenario's own policy "weights of LABEL in
    SCENARIO", and by "scene of SCENARIO". Scenes that are absent have none.
    """
    digests = {}
    for name, scenario in scenarios.items():
        for variant in config.variants:
            key = f"weights of {variant.label}"
            if variant.policy == SCENARIO:
                key += f" in {name}"
            if key not in digests:
                file = weights_file(variant.config(config.speeds[0], scenario.policy))
                if file is not None:
                    digests[key] = _digest([file])
        if isinstance(scenario.world, SceneSource):
            try:
                scene = find_scene(scenario.world)
            except FileNotFoundError:
                continue
            files = [scene / flown for flown in _FLOWN_FILES] if scene.is_dir() else [scene]
            digests[f"scene of {name}"] = _digest([file for file in files if file.is_file()])
    return digests


def _digest(files: list[Path]) -> str:
    digest = hashlib.sha256()
    for file in files:
        digest.update(hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()[:16]


def kept_scenario(folder: StudyFolder, name: str) -> Scenario:
    """A scenario as a study flies it, its scene and weights in the study's folder.

    Raises:
        FileNotFoundError, ValueError: if it is not there or damaged.
    """
    file = folder.path / "scenarios" / f"{name}.yaml"
    scenario = load_config(Scenario(), file)
    try:
        scenario.validate()
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None
    if isinstance(scenario.world, SceneSource):
        scenario.world.path = str((folder.path / scenario.world.path).absolute())
    weights = folder.weights(_own(name))
    if weights.is_file():
        policy = replace(scenario.policy, weights=str(weights.absolute()))  # pyright: ignore
        scenario = replace(scenario, policy=policy)
    return scenario


def kept_flights(
    folder: StudyFolder, specs: Iterable[RolloutSpec]
) -> Iterator[tuple[RolloutSpec, Scenario]]:
    """
    Flights with the scenario of each, complete with policy and seed, from the study's folder alone.

    Raises:
        FileNotFoundError, ValueError: if the folder is damaged, or names a module that nobody has
            imported: files alone import nothing.
    """
    variants = {}
    for variant in folder.config().variants:
        module, colon, _ = variant.policy.partition(":")
        if colon and module not in sys.modules:
            raise ValueError(
                f"{folder.path} flies {variant.policy}, whose module is not imported; if you trust "
                f"it, add --import {module} in front of the verb"
            )
        if variant.weights is not None:
            kept = str(folder.weights(variant.label).absolute())
            variant = variant._replace(policy=kept)
        variants[variant.label] = variant
    scenarios: dict[str, Scenario] = {}
    for spec in specs:
        if spec.scenario not in scenarios:
            scenarios[spec.scenario] = kept_scenario(folder, spec.scenario)
        scenario = scenarios[spec.scenario]
        policy = variants[spec.policy].config(spec.speed, scenario.policy)
        yield spec, replace(scenario, policy=policy, seed=spec.seed)


def _keep_scenario(folder: StudyFolder, name: str, scenario: Scenario) -> None:
    file = folder.path / "scenarios" / f"{name}.yaml"
    text = dump_config(scenario)
    if file.is_file() and file.read_text() != text:
        raise ValueError(
            f"{file} differs from the scenario {name} of this program; choose another folder with "
            "--out, or finish the study with the program that began it"
        )
    with written_atomically(file) as path:
        path.write_text(text)


def _keep_scene(folder: StudyFolder, world: SceneSource) -> str:
    """Copies a scene into the study; returns where to, in its folder."""
    scene = find_scene(world)
    kept = folder.path / "scenes" / scene.name
    if not kept.exists():
        if scene.is_dir():
            with folder_written_atomically(kept) as partial:
                shutil.copytree(scene, partial, dirs_exist_ok=True)
        else:
            with written_atomically(kept) as partial:
                shutil.copyfile(scene, partial)
    return str(kept.relative_to(folder.path))


def _keep_weights(folder: StudyFolder, file: Path, label: str) -> str:
    """Copies weights into the study; returns where to, in its folder."""
    kept = folder.weights(label)
    if kept.is_file() and kept.read_bytes() != file.read_bytes():
        raise ValueError(
            f"{file} has changed since {folder.path} was begun; choose another folder with --out"
        )
    kept.parent.mkdir(exist_ok=True)
    with written_atomically(kept) as path:
        shutil.copyfile(file, path)
    return str(kept.relative_to(folder.path))


def _own(scenario: str) -> str:
    """What the weights of a scenario's own policy are kept as; no label is like it."""
    return f"scenarios/{scenario}"
