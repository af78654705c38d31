"""`splatpilot vehicle`, `splatpilot bridge` and `splatpilot px4`."""

import argparse
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
    vehicle = add_verb(
        verbs,
        "vehicle",
        _vehicle,
        help="simulate a vehicle that is flown by LCM messages",
        description="Hovers at the scenario's start until commands come, and flies by them, in "
        "real time: what `splatpilot bridge` flies where there is no real vehicle.",
        examples=(
            "vehicle --scenario P02 --policy diffaero",
            "vehicle --scenario P02 --policy diffaero --seed 3 --patience 60 --out out/vehicle_3",
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
            "bridge --scenario P02 --policy diffaero",
            "bridge --scenario room.yaml --hardware room_hardware.yaml --log flight.lcm",
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
            "px4 --set vehicle_host=192.168.8.1",
            "px4 --config px4.yaml --engage",
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
