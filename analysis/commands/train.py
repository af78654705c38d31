"""`flysplat train`."""

import argparse
from pathlib import Path

from flysplat.analysis.commands.overrides import add_overrides


def add_to(verbs: argparse._SubParsersAction) -> None:
    train = verbs.add_parser("train", help="train a policy that flies by depth")
    train.set_defaults(verb=_train)
    train.add_argument(
        "policy", choices=["diffaero", "depthnav", "agile_autonomy"], help="which one"
    )
    train.add_argument(
        "--out",
        type=Path,
        required=True,
        help="folder to write; an interrupted run of the same configuration goes on there",
    )
    train.add_argument("--config", type=Path, help="YAML file with fields of the configuration")
    add_overrides(train, "schedule.updates=2000")


def _train(options: argparse.Namespace) -> None:
    from flysplat.diagrams.configuration import load_config
    from flysplat.training.policies.registry import RECIPES
    from flysplat.training.policies.train import run

    recipe = RECIPES[options.policy]
    run(
        config=load_config(recipe.config(), options.config, options.overrides),
        out=options.out,
        make=recipe.make,
    )
