"""`splatpilot recover`."""

import argparse
from pathlib import Path

from splatpilot.analysis.commands.options import (
    LEARN_FROM_CORPORA,
    add_overrides,
    add_verb,
    check_config,
    check_corpora,
)
from splatpilot.analysis.commands.train import trainer_defaults


def add_to(verbs: argparse._SubParsersAction) -> None:
    recover = add_verb(
        verbs,
        "recover",
        _recover,
        help="train a student, have it fly, and train it anew with what it should have done",
        description="Trains a student on corpora, has it fly in their worlds, labels what came "
        "before its near-misses and crashes, and trains it again. Interrupted, the same command "
        "goes on.",
        examples=(
            "recover student_rgb --out out/rgb --set 'corpora=[out/corpus]'",
            "recover student_depth --out out/depth --set 'corpora=[out/corpus]' --flights 3",
            "recover student_rgb --out out/next --set 'corpora=[out/rgb/corpora/0]' "
            "--flown-by out/rgb/stage_2/student_rgb.npz",
        ),
    )
    recover.add_argument("policy", choices=LEARN_FROM_CORPORA)
    recover.add_argument(
        "--out",
        type=Path,
        required=True,
        help="folder to write; an interrupted run of the same configuration goes on there",
    )
    recover.add_argument(
        "--flights", type=int, default=6, metavar="N", help="in each world, at most (%(default)s)"
    )
    recover.add_argument(
        "--flown-by",
        default="",
        metavar="POLICY",
        help="name, or file of weights, of who flies instead of a student that is trained first",
    )
    recover.add_argument("--jobs", type=int, metavar="N", help="processes that fly; default: cores")
    recover.add_argument("--config", type=Path, help="YAML file with fields of the configuration")
    add_overrides(recover, ("'corpora=[out/corpus]'", "schedule.updates=2000"), trainer_defaults)


def _recover(options: argparse.Namespace) -> None:
    check_config(options.config)
    check_corpora([options.policy], options.overrides, options.config)
    from splatpilot.systems.common.progress import resumable, say

    say(f"training {options.policy} with recovery in {options.out}")
    from splatpilot.systems.common.config import load_config
    from splatpilot.systems.common.processes import available_cores
    from splatpilot.training.policies import recover as recovery
    from splatpilot.training.policies.trainer_registry import TRAINERS

    config = load_config(trainer_defaults(options), options.config, options.overrides)
    jobs = available_cores() if options.jobs is None else options.jobs
    make = TRAINERS.find(options.policy).make
    with resumable(lambda: f"what is finished is in {options.out}; the same command resumes"):
        ledger = recovery.run(
            config=config,
            make=make,
            out=options.out,
            flights=options.flights,
            jobs=jobs,
            flown_by=options.flown_by,
        )
    flown = ", ".join(f"{count} {outcome}" for outcome, count in ledger["flights"].items())
    print(
        f"{flown}; {ledger['near_misses']} near-misses; {ledger['recovery_samples']} samples of "
        f"recovery beside {ledger['expert_samples']} of the expert; weights in "
        f"{options.out / 'stage_2' / options.policy}.npz"
    )
