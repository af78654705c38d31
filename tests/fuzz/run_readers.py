"""What reads files of our own runs: configurations, weights and studies."""

import re
from pathlib import Path
from typing import Any

import numpy as np

from fuzz import samples
from fuzz.readers import Reader, require_finite


def _scenario(folder: Path) -> Any:
    from splatpilot.diagrams.flight.scenario import Scenario
    from splatpilot.systems.common.config import load_config

    scenario = load_config(Scenario(), folder / "scenario.yaml")
    scenario.validate()
    return scenario


def _write_scenario(folder: Path) -> None:
    from splatpilot.diagrams.flight.scenario import Scenario
    from splatpilot.systems.common.config import dump_config

    (folder / "scenario.yaml").write_text(dump_config(Scenario()))


def _names_field(message: str, folder: Path) -> bool:
    """Fields of configurations say which they are: overrides may have set them, and no file."""
    value = r" (?:is|are|=|times|would|of|leaves|must|has no place) "
    return str(folder) in message or re.match(rf"^[\w.' ]*?[\w.]+{value}", message) is not None


def _use_config(config: Any) -> None:
    from splatpilot.systems.common.config import dump_config, parse_config

    again = parse_config(type(config)(), dump_config(config), "its own text")
    assert dump_config(again) == dump_config(config), "it is not what it writes"
    again.validate()


def _write_training(folder: Path) -> None:
    from splatpilot.systems.common.config import dump_config
    from splatpilot.training.reconstruction.config import ReconstructConfig

    (folder / "config.yaml").write_text(dump_config(ReconstructConfig()))


def _training(folder: Path) -> Any:
    from splatpilot.systems.common.config import load_config
    from splatpilot.training.reconstruction.config import ReconstructConfig

    config = load_config(ReconstructConfig(), folder / "config.yaml")
    config.validate()
    return config


def _write_weights(folder: Path) -> None:
    from splatpilot.systems.policies.checkpoint import PolicyCheckpoint
    from splatpilot.systems.policies.diffaero import DIFFAERO_NETWORK

    rng = np.random.default_rng(0)
    weights = {
        name: rng.normal(scale=0.1, size=shape).astype(np.float32)
        for name, shape in DIFFAERO_NETWORK.weight_shapes().items()
    }
    checkpoint = PolicyCheckpoint("diffaero", DIFFAERO_NETWORK, weights, {"seed": 3})
    checkpoint.save(folder / "diffaero.npz")


def _read_weights(folder: Path) -> Any:
    from splatpilot.systems.policies.diffaero import DIFFAERO_NETWORK
    from splatpilot.systems.policies.recurrent_network import load_network

    return load_network(str(folder / "diffaero.npz"), "diffaero", DIFFAERO_NETWORK)


def _use_weights(network: Any) -> None:
    spec = network.spec
    image = np.ones((spec.image_height, spec.image_width), np.float32)
    state, hidden = np.ones(spec.state_size, np.float32), np.zeros(spec.hidden_size, np.float32)
    for _ in range(3):
        output, hidden = network.step(image, state, hidden)
        require_finite(output, hidden)


def _read_study(folder: Path) -> Any:
    from splatpilot.analysis.benchmark.study_folder import StudyFolder, kept_flights

    study = StudyFolder(folder / "study")
    specs = study.config().rollouts()
    assert study.program() and study.shard() is None
    flights = [study.read(spec) for spec in specs]
    return study, flights, list(kept_flights(study, specs))


def _use_study(read: Any) -> None:
    from splatpilot.analysis.benchmark.tables import policy_table

    study, flights, kept = read
    policy_table([row for row, _ in flights], study.config(), 0)
    for (spec, scenario), (row, arrays) in zip(kept, flights, strict=True):
        assert row["id"] == spec.id
        study.read_timing(spec.id)
        scenario.validate()
        if arrays:
            require_finite(arrays["times"], arrays["states"])


RUN_READERS = {
    "scenario": Reader(_write_scenario, "*", _scenario, _use_config, _names_field),
    "configuration": Reader(_write_training, "*", _training, _use_config, _names_field),
    "weights": Reader(_write_weights, "*", _read_weights, _use_weights),
    "study": Reader(
        samples.write_study,
        "study/study.yaml study/rollouts/* study/scenarios/* study/timings/*",
        _read_study,
        _use_study,
    ),
}
