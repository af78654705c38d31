"""The student's two stages: from what its expert shows, and then also from what the expert would
have done where the student came too near to something.

After the paper, Sec. III-B. The student of the first stage flies, without any guard, the ways that
the expert flew in the worlds that it was trained in; the second is trained from nothing on all. For
`diffaero_rgb`, which learns from the same corpora what it sees, the images alone matter. Another
policy's flights may take the place of the first stage, as those of the round before.
"""

import json
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from hashlib import blake2b
from itertools import chain
from pathlib import Path
from typing import Any, ClassVar, Protocol

from splatpilot.diagrams.policies import policy_named
from splatpilot.systems.files import written_atomically
from splatpilot.systems.messages import require
from splatpilot.systems.output_folders import claim_folder, holds_folder
from splatpilot.systems.progress import say
from splatpilot.systems.provenance import revision
from splatpilot.training.corpus.corpus import Corpus, distinct_shards, distinct_worlds
from splatpilot.training.corpus.linked_corpus import link_corpus
from splatpilot.training.corpus.recovery import add_recovery
from splatpilot.training.corpus.sample import EXPERT, RECOVERY
from splatpilot.training.policies import train
from splatpilot.training.policies.student_data import is_held_out
from splatpilot.training.policies.student_flights import fly_worlds, tasks_of
from splatpilot.training.policies.trainer import Trainer, TrainingConfig


class CorpusTraining(TrainingConfig, Protocol):
    """What the configuration of a trainer has that learns from corpora, a dataclass."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    corpora: list[str]
    """Their folders."""
    held_out: float
    """Part of their worlds, by name, that is not trained with."""


@dataclass
class RecoveryFlights:
    """The content of `recovery.yaml`: what decides a run beside the configuration of training."""

    # [-] Of the student, at most, in each world.
    flights: int = 6
    # Policy, or file of weights, that flies; the first stage's where left empty.
    flown_by: str = ""
    # What tells the content of that file from what it may have later.
    flown_by_digest: str = ""
    # Folders of the corpora, and the part of their worlds that is not trained with.
    corpora: list[str] = field(default_factory=list)
    held_out: float = 0.0


@holds_folder("out")
def run[Config: CorpusTraining](
    *,
    config: Config,
    make: Callable[[Config], Trainer],
    out: Path,
    flights: int,
    jobs: int,
    flown_by: str = "",
) -> dict[str, Any]:
    """
    Trains a student, has it fly, gathers what it was to have done, and trains another on all.

    Interrupted anywhere, even by `kill -9`, the same call goes on and leaves the same. The corpora
    that `config` names stay as they are.

    Leaves in `out`: `stage_1`, unless another policy flies, and `stage_2`, see `train.run`;
    `corpora`, links to those of `config` with the recovery samples beside them; `flights`, what the
    student flew, a file a world; `recovery.yaml`, how many they may be, whose and where;
    `recovery.json`, how many of what there are.

    Args:
        config: of both stages.
        make: the trainer of that configuration.
        flights: of the student, at most, in each world.
        jobs: processes that fly.
        flown_by: a policy or a file of weights that flies instead of a first stage. Students see
            through the corpora's camera, others through their own.

    Returns:
        What `recovery.json` says.

    Raises:
        FileNotFoundError, ValueError: see `train.run`, `add_recovery` and `policy_named`; or if
            `out` holds something else.
        OSError: if `out` cannot be written, or a process was killed.
    """
    for name, value in (("flights", flights), ("jobs", jobs)):
        require(value >= 1, f"--{name}", "at least 1", value)
    # What is not there is refused before anything is written.
    if flown_by:
        policy_named(flown_by)
    worlds = distinct_worlds([Corpus(Path(source)) for source in config.corpora])
    digest = _digest(Path(flown_by)) if flown_by.endswith(".npz") else ""
    decisive = RecoveryFlights(flights, flown_by, digest, list(config.corpora), config.held_out)
    claim_folder(out / "recovery.yaml", decisive)
    pilot, first = flown_by, {}
    if not flown_by:
        say(f"first stage, in {out / 'stage_1'}")
        first = train.run(config=config, out=out / "stage_1", make=make)
        pilot = str(out / "stage_1" / f"{first['policy']}.npz")
    folders = [out / "corpora" / str(k) for k in range(len(config.corpora))]
    for source, folder in zip(config.corpora, folders, strict=True):
        link_corpus(Path(source), folder)
    corpora = [Corpus(folder) for folder in folders]
    others = {s.revision for corpus in corpora for s in corpus.shards} - {revision()}
    if others:
        say(
            f"what the corpora hold was labelled by revision {', '.join(sorted(others))} of the "
            f"program, recovery by {revision()}; ledger.csv tells which"
        )
    held_out = {name for name in worlds if is_held_out(name, config.held_out)}
    outcomes: Counter[str] = Counter()
    for folder, corpus, shards in zip(folders, corpora, distinct_shards(corpora), strict=True):
        tasks = tasks_of([shard for shard in shards if shard.world not in held_out], flights)
        flown, ended = fly_worlds(corpus, tasks, pilot, out / "flights" / folder.name, jobs)
        outcomes += ended
        add_recovery(folder, flown, jobs)
    both = replace(config, corpora=[str(folder) for folder in folders])
    say(f"second stage, in {out / 'stage_2'}")
    second = train.run(config=both, out=out / "stage_2", make=make)
    ledger = _ledger([Corpus(folder) for folder in folders], outcomes)
    ledger |= {"flown_by": flown_by} if flown_by else {"stage_1": first}
    ledger["stage_2"] = second
    with written_atomically(out / "recovery.json") as path:
        path.write_text(json.dumps(ledger, indent=2) + "\n")
    return ledger


def _digest(file: Path) -> str:
    return blake2b(file.read_bytes(), digest_size=16).hexdigest()


def _ledger(corpora: Sequence[Corpus], outcomes: Counter[str]) -> dict[str, Any]:
    """How many flights ended how, near-misses that they had, and samples by where they are from."""
    shards = list(chain.from_iterable(distinct_shards(corpora)))
    recovered = [shard for shard in shards if shard.source == RECOVERY]
    return {
        "flights": dict(sorted(outcomes.items())),
        "revisions": sorted({shard.revision for shard in shards}),
        "near_misses": sum(f["near_misses"] for shard in recovered for f in shard.flights),
        "expert_samples": sum(len(shard) for shard in shards if shard.source == EXPERT),
        "recovery_samples": sum(map(len, recovered)),
    }
