"""`splatpilot hardware`: flights by messages."""

import argparse
import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

from splatpilot.analysis.commands.options import (
    add_overrides,
    add_overwrite,
    add_scenario,
    add_verb,
    check_config,
    read_scenario,
)
from splatpilot.systems.common.files import require_unused


def add_to(verbs: argparse._SubParsersAction) -> None:
    hardware = add_verb(
        verbs,
        "hardware",
        None,
        help="fly vehicles, real or simulated, by messages",
        description="Flies a real or simulated vehicle by LCM messages or PX4, or tests the "
        "failsafe by faults.",
        examples=("hardware vehicle --scenario P02", "hardware bridge --scenario P02"),
    )
    actions = hardware.add_subparsers(required=True, metavar="ACTION")
    _add_hardware(actions)
    _add_faults(actions)


def _add_hardware(verbs: argparse._SubParsersAction) -> None:
    vehicle = add_verb(
        verbs,
        "vehicle",
        _vehicle,
        help="simulate a vehicle that is flown by LCM messages",
        description="Hovers at the scenario's start until commands come, and flies by them, in "
        "real time: what `splatpilot hardware bridge` flies where there is no real vehicle.",
        examples=(
            "hardware vehicle --scenario P02 --policy diffaero",
            "hardware vehicle --scenario P02 --seed 3 --patience 60 --out out/vehicle_3",
        ),
    )
    vehicle.add_argument(
        "--out", type=Path, default=Path("out/vehicle"), help="output folder (%(default)s)"
    )
    bridge = add_verb(
        verbs,
        "bridge",
        _bridge,
        help="fly a vehicle, real or simulated, by LCM messages",
        description="Runs policy, controller and failsafe against a vehicle that sends its state "
        "and what it sees, and takes commands.",
        examples=(
            "hardware bridge --scenario P02 --policy diffaero",
            "hardware bridge --scenario room.yaml --hardware room_hardware.yaml --log flight.lcm",
        ),
    )
    bridge.add_argument("--log", type=Path, help="write all messages to this file, as lcm-logger")
    px4 = add_verb(
        verbs,
        "px4",
        _px4,
        help="let the bridge fly a vehicle that PX4 flies, by MAVLink",
        description="Stands where the simulated vehicle stands: sends PX4's estimate on to the "
        "bridge, and the bridge's commands on to PX4. Arms nothing unless told to.",
        examples=(
            "hardware px4 --set vehicle_host=192.168.8.1",
            "hardware px4 --config px4.yaml --engage",
        ),
    )
    px4.add_argument("--config", type=Path, metavar="FILE", help="YAML with fields of Px4Config")
    px4.add_argument("--lcm-url", metavar="URL", help="where the bridge is")
    px4.add_argument("--engage", action="store_true", help="ask for offboard mode")
    px4.add_argument("--arm", action="store_true", help="arm the motors, in offboard mode")
    add_overrides(px4, ("vehicle_host=192.168.8.1", "udp.host=0.0.0.0"), _px4_defaults)
    for parser in (vehicle, bridge):
        parser.add_argument(
            "--hardware", type=Path, metavar="FILE", help="YAML with fields of HardwareConfig"
        )
        parser.add_argument("--lcm-url", metavar="URL", help="where messages travel")
        parser.add_argument(
            "--patience", type=float, metavar="S", help="how long to wait for messages [s]"
        )
        add_overwrite(parser)
        add_scenario(parser)


def _vehicle(options: argparse.Namespace) -> None:
    require_unused(options.out, options.overwrite)
    check_config(options.hardware)
    scenario = read_scenario(options)
    from splatpilot.diagrams.hardware import vehicle

    vehicle.run(scenario=scenario, config=_config(options), out=options.out)


def _bridge(options: argparse.Namespace) -> None:
    if options.log is not None:
        require_unused(options.log, options.overwrite)
    check_config(options.hardware)
    scenario = read_scenario(options)
    from splatpilot.diagrams.hardware import bridge

    bridge.run(
        scenario=scenario,
        config=_config(options),
        log=options.log,
        overwrite=options.overwrite,
    )


def _px4_defaults(options: argparse.Namespace) -> Any:
    from splatpilot.diagrams.hardware.px4 import Px4Config

    return Px4Config()


def _px4(options: argparse.Namespace) -> None:
    check_config(options.config)
    from splatpilot.diagrams.hardware import px4
    from splatpilot.systems.common.config import load_config

    config = load_config(_px4_defaults(options), options.config, options.overrides)
    if options.lcm_url is not None:
        config.url = options.lcm_url
    config.commander.engage |= options.engage
    config.commander.arm |= options.arm
    px4.run(config=config)


def _config(options: argparse.Namespace):
    from splatpilot.diagrams.hardware.bridge import HardwareConfig
    from splatpilot.systems.common.config import load_config

    given = {"url": options.lcm_url, "patience": options.patience}
    given = {name: value for name, value in given.items() if value is not None}
    return replace(load_config(HardwareConfig(), options.hardware), **given)


def _add_faults(verbs: argparse._SubParsersAction) -> None:
    faults = add_verb(
        verbs,
        "faults",
        _faults,
        help="fly while messages, clocks and policies fail",
        description="Flies hundreds of short flights through the bridge while messages are lost, "
        "late or false, clocks jump or policies fail, and counts which ended safely. Interrupted, "
        "the same command goes on.",
        examples=(
            "hardware faults --set trials=30",
            "hardware faults --out out/faults_1 --set seed=1",
        ),
    )
    faults.add_argument(
        "--out", type=Path, default=Path("out/faults"), help="output folder (%(default)s)"
    )
    faults.add_argument("--config", type=Path, help="YAML file with fields of the configuration")
    add_overrides(faults, ("trials=30", "seed=1", "scenario.timeout=20"), _faults_defaults)


def _faults_defaults(options: argparse.Namespace) -> Any:
    from splatpilot.analysis.faults.campaign import FaultsConfig

    return FaultsConfig()


def _faults(options: argparse.Namespace) -> None:
    check_config(options.config)
    from splatpilot.analysis.faults.campaign import run
    from splatpilot.systems.common.config import load_config

    config = load_config(_faults_defaults(options), options.config, options.overrides)
    # Thousands of packets are refused, and policies raise, on purpose.
    loggers = [logging.getLogger(name) for name in ("drake", "splatpilot")]
    levels = [logger.level for logger in loggers]
    try:
        for logger in loggers:
            logger.setLevel(logging.CRITICAL)
        run(config=config, out=options.out)
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
