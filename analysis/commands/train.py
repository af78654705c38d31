"""`splatpilot train`."""

import argparse
from pathlib import Path
from typing import Any

from splatpilot.analysis.commands.options import (
    TRAINERS,
    add_named,
    add_overrides,
    add_verb,
    check_config,
    check_corpora,
    check_scenario,
    check_trainer,
)


def add_to(verbs: argparse._SubParsersAction) -> None:
    train = add_verb(
        verbs,
        "train",
        _train,
        help="train policies",
        description="Trains policies, one after the other, and writes weights, a model card and "
        "curves of each. If interrupted, the same command resumes.",
        examples=(
            "train diffaero --out out/forests --set 'worlds.kinds=[P02, P03]' --fly P03",
            "train diffaero depthnav --out out/both --seeds 0 1",
            "train student_depth --out out/student --set 'corpora=[out/corpus]'",
        ),
    )
    add_named(
        train,
        "policies",
        names=TRAINERS,
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
    train.add_argument("--config", type=Path, help="YAML file with fields of the configuration")
    train.add_argument(
        "--fly",
        metavar="P02,P03",
        help="scenarios of the benchmark to fly when trained, five seeds of each",
    )
    add_overrides(train, ("schedule.updates=2000", "seed=1"), trainer_defaults)


def trainer_defaults(options: argparse.Namespace) -> Any:
    """The configuration of the trainer that is named, the first of several, which `--set` changes.

    Raises:
        ValueError: if none is.
    """
    named = getattr(options, "policy", None) or getattr(options, "policies", None)
    if not named:
        raise ValueError("fields depend on the policy; name it before --set help")
    from splatpilot.training.policies.trainer_registry import TRAINERS

    return TRAINERS.find(named if isinstance(named, str) else named[0]).config()


def _train(options: argparse.Namespace) -> None:
    scenarios = [name.strip() for name in options.fly.split(",")] if options.fly else []
    for name in scenarios:
        check_scenario(name)  # before the training, not after it
    for policy in options.policies:
        check_trainer(policy)
    for what, given in (("policy", options.policies), ("seed", options.seeds or [])):
        if twice := [one for k, one in enumerate(given) if one in given[:k]]:
            raise ValueError(f"the {what} {twice[0]} is given twice; leave one out")
    check_config(options.config)
    check_corpora(options.policies, options.overrides, options.config)
    from splatpilot.systems.common.progress import resumable, say

    say(f"training {', '.join(options.policies)} in {options.out}")
    from splatpilot.systems.common.config import load_config
    from splatpilot.training.policies import train
    from splatpilot.training.policies.trainer_registry import TRAINERS

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
            runs.append((policy, config, out))
    weights = []
    with resumable(lambda: f"checkpoints are in {options.out}; the same command resumes"):
        for policy, config, out in runs:
            summary = train.run(config=config, out=out, make=TRAINERS.find(policy).make)
            weights.append(str(out / f"{summary['policy']}.npz"))
    if scenarios:
        from splatpilot.analysis.benchmark import run_study as benchmark
        from splatpilot.analysis.benchmark.study import StudyConfig

        study = StudyConfig(scenarios=scenarios, policies=weights, seeds=5)
        benchmark.run(config=study, out=options.out / "benchmark")
