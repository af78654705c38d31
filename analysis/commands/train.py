"""`splatpilot train`, `recover` and `corpus`."""

import argparse
from itertools import product
from typing import Any

from splatpilot.analysis.commands import options as cli
from splatpilot.analysis.commands.checks import (
    LEARN_FROM_CORPORA,
    TRAINER_NAMES,
    check_scenario,
    check_trainer,
)
from splatpilot.systems.common.validation import require


def _trainer_defaults(options: argparse.Namespace) -> Any:
    named = getattr(options, "policy", None) or getattr(options, "policies", None)
    if not named:
        raise ValueError("fields depend on the policy; name it before --set help")
    from splatpilot.training.policies.train import TRAINERS

    return TRAINERS.find(named if isinstance(named, str) else named[0]).config()


@cli.command(
    "train",
    cli.Option(
        "policies",
        "name of a trainer, such as diffaero, or module:attribute",
        nargs="+",
        metavar="POLICY",
        resolve=check_trainer,
        completions=TRAINER_NAMES,
    ),
    cli.out_option(
        "folder to write; resumes an interrupted run of the same configuration; several runs have "
        "subfolders POLICY, seed_N or POLICY/seed_N"
    ),
    cli.Option("--seeds N", "train with each of these", int, nargs="+"),
    cli.CONFIG,
    cli.Option(
        "--fly P02,P03",
        "scenarios of the benchmark to fly after training, five seeds of each",
        resolve=lambda text: [check_scenario(name.strip()) for name in text.split(",")],
    ),
    cli.set_option("schedule.updates=2000", "seed=1", configuration=_trainer_defaults),
    examples=(
        "train diffaero --out out/forests --set 'worlds.kinds=[P02, P03]' --fly P03",
        "train diffaero depthnav --out out/both --seeds 0 1",
        "train student_depth --out out/student --set 'corpora=[out/corpus]'",
    ),
)
def train(options: argparse.Namespace) -> None:
    """Trains policies, one after the other, and writes weights, a model card and curves of each. If
    interrupted, the same command resumes."""
    for what, given in (("policy", options.policies), ("seed", options.seeds or [])):
        if repeated := [one for k, one in enumerate(given) if one in given[:k]]:
            raise ValueError(f"the {what} {repeated[0]} is given twice; leave one out")
    cli.announce(f"training {', '.join(options.policies)} in {options.out}")
    from splatpilot.systems.common.config import load_config
    from splatpilot.systems.common.progress import resumable
    from splatpilot.training.policies import train
    from splatpilot.training.policies.train import TRAINERS

    runs = []
    for policy, seed in product(options.policies, options.seeds or [None]):
        overrides = [*options.overrides, *([] if seed is None else [f"seed={seed}"])]
        config = load_config(TRAINERS.find(policy).config(), options.config, overrides)
        out = options.out
        if len(options.policies) > 1:
            out = out / policy.rpartition(":")[2]
        runs.append((policy, config, out if seed is None else out / f"seed_{seed}"))
    weights = []
    with resumable(lambda: f"checkpoints are in {options.out}; the same command resumes"):
        for policy, config, out in runs:
            summary = train.run(config=config, out=out, make=TRAINERS.find(policy).make)
            weights.append(str(out / f"{summary['policy']}.npz"))
    if options.fly:
        from splatpilot.analysis.benchmark import run_study
        from splatpilot.analysis.benchmark.study import StudyConfig

        study = StudyConfig(scenarios=options.fly, policies=weights, seeds=5)
        run_study.run(config=study, out=options.out / "benchmark")


@cli.command(
    "recover",
    cli.Option("policy", "student to train", choices=LEARN_FROM_CORPORA),
    cli.out_option("folder to write; resumes an interrupted run of the same configuration"),
    cli.Option("--flights N", "in each world, at most (%(default)s)", int, default=6),
    cli.Option(
        "--flown-by POLICY",
        "name or file of weights of the policy that flies, instead of a student that is trained "
        "first",
        default="",
    ),
    cli.JOBS,
    cli.CONFIG,
    cli.set_option(
        *("'corpora=[out/corpus]'", "schedule.updates=2000"), configuration=_trainer_defaults
    ),
    examples=(
        "recover student_depth --out out/depth --set 'corpora=[out/corpus]' --flights 3",
        "recover student_rgb --out out/next --set 'corpora=[out/rgb/corpora/0]' "
        "--flown-by out/rgb/stage_2/student_rgb.npz",
    ),
)
def recover(options: argparse.Namespace) -> None:
    """Trains a student on corpora, flies it in their worlds, labels what came before its
    near-misses and crashes, and trains it again. If interrupted, the same command resumes."""
    cli.announce(f"training {options.policy} with recovery in {options.out}")
    from splatpilot.systems.common.processes import available_cores
    from splatpilot.systems.common.progress import resumable
    from splatpilot.training.policies import recover
    from splatpilot.training.policies.train import TRAINERS

    config, make = cli.read_config(options), TRAINERS.find(options.policy).make
    jobs = available_cores() if options.jobs is None else options.jobs
    with resumable(lambda: f"what is finished is in {options.out}; the same command resumes"):
        result = cli.call(recover.run, options, config=config, make=make, jobs=jobs)
    flown = ", ".join(f"{count} {outcome}" for outcome, count in result["flights"].items())
    print(
        f"{flown}; {result['near_misses']} near-misses; {result['recovery_samples']} samples of "
        f"recovery and {result['expert_samples']} of the expert; weights in "
        f"{options.out / 'stage_2' / options.policy}.npz"
    )


@cli.command(
    "corpus make",
    cli.out_option("folder of the corpus"),
    cli.Option("--worlds N", "number of worlds", int, required=True),
    cli.JOBS,
    cli.CONFIG,
    cli.set_option(
        *("expert.speed=2.5", "perturbation.copies=3"),
        configuration="splatpilot.training.corpus.corpus:CorpusConfig",
    ),
    examples=("corpus make --out out/corpus --worlds 180",),
)
def make_corpus(options: argparse.Namespace) -> None:
    """Collects the samples that the folder is missing. The same command resumes, and extends the
    corpus to more worlds."""
    cli.announce(f"collecting a corpus of {options.worlds} worlds in {options.out}")
    from splatpilot.training.corpus import collect

    print(f"{cli.call(collect.run, options, config=cli.read_config(options))} in {options.out}")


@cli.command(
    "corpus inspect",
    cli.path_option("corpus", "the folder of a corpus"),
    cli.out_option("image to draw", metavar="PNG", unused=True),
    cli.Option("--samples N", "(%(default)s)", int, default=12),
    cli.Option("--seed", "of the choice of samples (%(default)s)", int, default=0),
    cli.OVERWRITE,
    examples=("corpus inspect out/corpus --out samples.png --samples 24 --seed 1",),
)
def inspect_corpus(options: argparse.Namespace) -> None:
    """Reads a whole corpus, checks every byte of it, and draws some samples: color above depth,
    with the trajectories over both."""
    require(options.out.suffix.lower() == ".png", "--out", "a PNG file", options.out)
    require(options.samples >= 1, "--samples", "at least 1", options.samples)
    from splatpilot.analysis.figures import draw_sheet
    from splatpilot.training.corpus.corpus import Corpus

    corpus = Corpus(options.corpus)
    corpus.verify()
    draw_sheet(corpus, options.out, options.samples, options.seed)
    print(f"{corpus}; drew {options.out}")


@cli.command(
    "corpus export",
    cli.path_option("corpus", "the folder of a corpus"),
    cli.out_option("folder of the dataset", unused=True),
    cli.OVERWRITE,
    examples=("corpus export out/corpus --out out/lerobot",),
)
def export_corpus(options: argparse.Namespace) -> None:
    """Exports the expert's flights as a LeRobotDataset of version 3.0: parquet files, and videos of
    color and depth."""
    from splatpilot.training.corpus.corpus import Corpus
    from splatpilot.training.corpus.lerobot import export

    print(export(Corpus(options.corpus), options.out, replace=options.overwrite))
