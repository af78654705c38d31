"""`splatpilot vehicle`, `splatpilot bridge` and `splatpilot px4`."""

import argparse
import logging
from dataclasses import replace
from pathlib import Path

from splatpilot.analysis.commands.overrides import add_overrides
from splatpilot.analysis.commands.scenario_options import add_scenario, read_scenario


def add_to(verbs: argparse._SubParsersAction) -> None:
    vehicle = verbs.add_parser("vehicle", help="simulate a vehicle that is flown by LCM messages")
    vehicle.set_defaults(verb=_vehicle)
    vehicle.add_argument(
        "--out", type=Path, default=Path("out/vehicle"), help="output folder (%(default)s)"
    )
    bridge = verbs.add_parser("bridge", help="fly a vehicle, real or simulated, by LCM messages")
    bridge.set_defaults(verb=_bridge)
    bridge.add_argument("--log", type=Path, help="write all messages to this file, as lcm-logger")
    px4 = verbs.add_parser("px4", help="let the bridge fly a vehicle that PX4 flies, by MAVLink")
    px4.set_defaults(verb=_px4)
    px4.add_argument("--config", type=Path, metavar="FILE", help="YAML with fields of Px4Config")
    px4.add_argument("--lcm-url", metavar="URL", help="where the bridge is")
    px4.add_argument("--engage", action="store_true", help="ask for offboard mode")
    px4.add_argument("--arm", action="store_true", help="arm the motors, in offboard mode")
    add_overrides(px4, "vehicle_host=192.168.8.1")
    for parser in (vehicle, bridge):
        parser.add_argument(
            "--hardware", type=Path, metavar="FILE", help="YAML with fields of HardwareConfig"
        )
        parser.add_argument("--lcm-url", metavar="URL", help="where messages travel")
        parser.add_argument(
            "--patience", type=float, metavar="S", help="how long to wait for messages [s]"
        )
        add_scenario(parser)


def _vehicle(options: argparse.Namespace) -> None:
    from splatpilot.diagrams import vehicle

    vehicle.run(scenario=read_scenario(options), config=_config(options), out=options.out)


def _bridge(options: argparse.Namespace) -> None:
    from splatpilot.diagrams import bridge

    bridge.run(scenario=read_scenario(options), config=_config(options), log=options.log)


def _px4(options: argparse.Namespace) -> None:
    from splatpilot.diagrams import px4
    from splatpilot.diagrams.px4_config import Px4Config
    from splatpilot.systems.configuration import load_config

    logging.getLogger("drake").setLevel(logging.WARNING)
    config = load_config(Px4Config(), options.config, options.overrides)
    if options.lcm_url is not None:
        config.url = options.lcm_url
    config.commander.engage |= options.engage
    config.commander.arm |= options.arm
    px4.run(config=config)


def _config(options: argparse.Namespace):
    from splatpilot.diagrams.hardware_config import HardwareConfig
    from splatpilot.systems.configuration import load_config

    logging.getLogger("drake").setLevel(logging.WARNING)
    given = {"url": options.lcm_url, "patience": options.patience}
    given = {name: value for name, value in given.items() if value is not None}
    return replace(load_config(HardwareConfig(), options.hardware), **given)
