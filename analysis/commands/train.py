"""`splatpilot train`."""

import argparse
from pathlib import Path

from splatpilot.analysis.commands.overrides import add_overrides


def add_to(verbs: argparse._SubParsersAction) -> None:
    train = verbs.add_parser("train", help="train policies")
    train.set_defaults(verb=_train)
    train.add_argument(
        "policies",
        metavar="POLICY",
        nargs="+",
        help="name of a trainer, such as diffaero, or module:attribute of one of your own",
    )
    train.add_argument(
        "--out",
        type=Path,
        required=True,
        help="folder to write; an interrupted run of the same configuration goes on there; several "
        "runs have folders in it, POLICY or seed_N or both",
    )
    train.add_argument("--seeds", type=int, nargs="+", metavar="N", help="train with each of these")
    train.add_argument(
        "--jobs", type=int, metavar="N", help="runs at a time, one core each; default: cores"
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
    from splatpilot.systems.cores import available_cores
    from splatpilot.training.policies.registry import TRAINERS
    from splatpilot.training.policies.side_by_side import TrainingRun, run_side_by_side

    if options.jobs is not None and options.jobs < 1:
        raise ValueError(f"--jobs is {options.jobs}; it must be at least 1")
    scenarios = [name.strip() for name in options.fly.split(",")] if options.fly else []
    for name in scenarios:
        scenario_file(name)  # before the training, not after it
    runs = []
    for policy in options.policies:
        for seed in options.seeds or [None]:
            overrides = [*options.overrides, *([] if seed is None else [f"seed={seed}"])]
            config = load_config(TRAINERS.find(policy).config(), options.config, overrides)
            out = options.out
            if len(options.policies) > 1:
                out = out / policy.rpartition(":")[2]
            if seed is not None:
                out = out / f"seed_{seed}"
            runs.append(TrainingRun(policy, config, out))
    summaries = run_side_by_side(runs, options.jobs or available_cores())
    if scenarios:
        weights = [
            str(run.out / f"{summary['policy']}.npz")
            for run, summary in zip(runs, summaries, strict=True)
        ]
        study = StudyConfig(scenarios=scenarios, policies=weights, seeds=5)
        benchmark.run(config=study, out=options.out / "benchmark")
