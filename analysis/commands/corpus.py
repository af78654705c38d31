"""`splatpilot corpus`: what students learn from."""

import argparse
from pathlib import Path
from typing import Any

from splatpilot.analysis.commands.options import (
    add_overrides,
    add_overwrite,
    add_verb,
    check_config,
)
from splatpilot.systems.common.files import require_existing, require_unused
from splatpilot.systems.common.validation import require


def add_to(verbs: argparse._SubParsersAction) -> None:
    corpus = add_verb(
        verbs,
        "corpus",
        None,
        help="gather what students learn from, or look at it",
        description="What students learn from: what an expert saw, and what was best to do then.",
        examples=(
            "corpus make --out out/corpus --worlds 18",
            "corpus inspect out/corpus --out sheet.png",
        ),
    )
    actions = corpus.add_subparsers(required=True, metavar="ACTION")
    _add_make(actions)
    _add_inspect(actions)


def _add_make(actions: argparse._SubParsersAction) -> None:
    make = add_verb(
        actions,
        "make",
        _make,
        help="fly the expert through many worlds and keep what it saw and did",
        description="Gathers what the folder lacks. Run again it goes on; with more worlds it adds "
        "to them.",
        examples=(
            "corpus make --out out/corpus --worlds 180",
            "corpus make --out out/held_out --worlds 36 --set worlds.held_out=true",
        ),
    )
    make.add_argument("--out", type=Path, required=True, help="folder of the corpus")
    make.add_argument("--worlds", type=int, required=True, metavar="N", help="in how many worlds")
    make.add_argument("--jobs", type=int, metavar="N", help="worker processes; default: cores")
    make.add_argument("--config", type=Path, help="YAML file with fields of the configuration")
    add_overrides(
        make, ("expert.speed=2.5", "worlds.held_out=true", "perturbation.copies=3"), _make_defaults
    )


def _make_defaults(options: argparse.Namespace) -> Any:
    from splatpilot.training.corpus.corpus import CorpusConfig

    return CorpusConfig()


def _make(options: argparse.Namespace) -> None:
    check_config(options.config)
    from splatpilot.systems.common.progress import say

    say(f"collecting a corpus of {options.worlds} worlds in {options.out}")
    from splatpilot.systems.common.config import load_config
    from splatpilot.training.corpus import collect as make

    config = load_config(_make_defaults(options), options.config, options.overrides)
    corpus = make.run(config=config, out=options.out, worlds=options.worlds, jobs=options.jobs)
    print(f"{corpus} in {options.out}")


def _add_inspect(actions: argparse._SubParsersAction) -> None:
    inspect = add_verb(
        actions,
        "inspect",
        _inspect,
        help="draw samples with their trajectories, and check every byte",
        description="Reads a whole corpus, checks every byte of it, and draws some samples: color "
        "above depth, with the trajectories over both.",
        examples=(
            "corpus inspect out/corpus --out sheet.png",
            "corpus inspect out/corpus --out sheet.png --samples 24 --seed 1 --overwrite",
        ),
    )
    inspect.add_argument("corpus", type=Path, help="folder of a corpus")
    inspect.add_argument("--out", type=Path, required=True, metavar="PNG", help="sheet to draw")
    inspect.add_argument("--samples", type=int, default=12, metavar="N", help="(%(default)s)")
    inspect.add_argument("--seed", type=int, default=0, help="which samples (%(default)s)")
    add_overwrite(inspect)


def _inspect(options: argparse.Namespace) -> None:
    require_existing(options.corpus, "the folder of a corpus")
    require_unused(options.out, options.overwrite)
    require(options.out.suffix.lower() == ".png", "--out", "a PNG file", options.out)
    require(options.samples >= 1, "--samples", "at least 1", options.samples)
    from splatpilot.analysis.corpus_sheet import draw_sheet
    from splatpilot.training.corpus.corpus import Corpus

    corpus = Corpus(options.corpus)
    corpus.verify()
    draw_sheet(corpus, options.out, options.samples, options.seed)
    print(f"{corpus}; drew {options.out}")
