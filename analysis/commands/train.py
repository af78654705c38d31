"""`splatpilot train`."""

import argparse
from pathlib import Path

from splatpilot.analysis.commands.overrides import add_overrides


def add_to(verbs: argparse._SubParsersAction) -> None:
    train = verbs.add_parser("train", help="train a policy")
    train.set_defaults(verb=_train)
    train.add_argument(
        "policy",
        metavar="POLICY",
        help="name of a trainer, such as diffaero, or module:attribute of one of your own",
    )
    train.add_argument(
        "--out",
        type=Path,
        required=True,
        help="folder to write; an interrupted run of the same configuration goes on there",
    )
    train.add_argument("--config", type=Path, help="YAML file with fields of the configuration")
    train.add_argument(
        "--fly",
        metavar="P02,P03",
        help="scenarios of the benchmark to fly when trained, five seeds of each",
    )
    add_overrides(train, "schedule.updates=2000")


def _train(options: argparse.Namespace) -> None:
    from splatpilot.analysis.benchmark import run as benchmark
    from splatpilot.analysis.benchmark.study import StudyConfig
    from splatpilot.diagrams.scenario_files import scenario_file
    from splatpilot.systems.configuration import load_config
    from splatpilot.training.policies.registry import TRAINERS
    from splatpilot.training.policies.train import run

    scenarios = [name.strip() for name in options.fly.split(",")] if options.fly else []
    for name in scenarios:
        scenario_file(name)  # before the training, not after it
    trainer = TRAINERS.find(options.policy)
    summary = run(
        config=load_config(trainer.config(), options.config, options.overrides),
        out=options.out,
        make=trainer.make,
    )
    if scenarios:
        study = StudyConfig(
            scenarios=scenarios,
            policies=[str(options.out / f"{summary['policy']}.npz")],
            seeds=5,
        )
        benchmark.run(config=study, out=options.out / "benchmark")
