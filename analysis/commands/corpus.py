"""`splatpilot corpus`: what students learn from."""

import argparse
from pathlib import Path

from splatpilot.analysis.commands.overrides import add_overrides


def add_to(verbs: argparse._SubParsersAction) -> None:
    corpus = verbs.add_parser("corpus", help="gather what students learn from, or look at it")
    actions = corpus.add_subparsers(required=True, metavar="ACTION")
    _add_make(actions)
    _add_inspect(actions)


def _add_make(actions: argparse._SubParsersAction) -> None:
    make = actions.add_parser(
        "make",
        help="fly the expert through many worlds and keep what it saw and did",
        description="Gathers what the folder lacks. Run again it goes on; with more worlds it adds "
        "to them.",
    )
    make.set_defaults(verb=_make)
    make.add_argument("--out", type=Path, required=True, help="folder of the corpus")
    make.add_argument("--worlds", type=int, required=True, metavar="N", help="in how many worlds")
    make.add_argument("--jobs", type=int, metavar="N", help="worker processes; default: cores")
    make.add_argument("--config", type=Path, help="YAML file with fields of the configuration")
    add_overrides(make, "expert.speed=2.5")


def _make(options: argparse.Namespace) -> None:
    from splatpilot.systems.configuration import load_config
    from splatpilot.training.corpus import make
    from splatpilot.training.corpus.config import CorpusConfig

    config = load_config(CorpusConfig(), options.config, options.overrides)
    corpus = make.run(config=config, out=options.out, worlds=options.worlds, jobs=options.jobs)
    print(f"{corpus} in {options.out}")


def _add_inspect(actions: argparse._SubParsersAction) -> None:
    inspect = actions.add_parser(
        "inspect",
        help="draw samples with their trajectories, and check every byte",
    )
    inspect.set_defaults(verb=_inspect)
    inspect.add_argument("corpus", type=Path, help="folder of a corpus")
    inspect.add_argument("--out", type=Path, required=True, metavar="PNG", help="sheet to draw")
    inspect.add_argument("--samples", type=int, default=12, metavar="N", help="(%(default)s)")
    inspect.add_argument("--seed", type=int, default=0, help="which samples (%(default)s)")


def _inspect(options: argparse.Namespace) -> None:
    from splatpilot.analysis.corpus_sheet import draw_sheet
    from splatpilot.training.corpus.corpus import Corpus

    if options.out.suffix.lower() != ".png":
        raise ValueError(f"--out is {options.out}; the sheet is a PNG file")
    if options.samples < 1:
        raise ValueError(f"--samples is {options.samples}; it must be at least 1")
    corpus = Corpus(options.corpus)
    for shard in corpus.shards:
        shard.verify()
    draw_sheet(corpus, options.out, options.samples, options.seed)
    print(f"{corpus}; drew {options.out}")
