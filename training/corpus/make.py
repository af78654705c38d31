"""Gathering a corpus, in any number of worlds side by side."""

import shutil
from functools import partial
from pathlib import Path

from splatpilot.systems.cores import available_cores
from splatpilot.systems.files import require_writable_folder
from splatpilot.systems.infeasible import InfeasibleFlightError
from splatpilot.systems.messages import require
from splatpilot.systems.output_folders import claim_folder, holds_folder
from splatpilot.systems.processes import map_processes
from splatpilot.systems.progress import Progress, resumable, say
from splatpilot.systems.provenance import revision
from splatpilot.training.corpus.config import CorpusConfig
from splatpilot.training.corpus.corpus import CONFIG, Corpus, entries
from splatpilot.training.corpus.gather import gather_world, shard_folder
from splatpilot.training.corpus.ledger import write_ledger
from splatpilot.training.corpus.library import world_source
from splatpilot.training.corpus.sample import EXPERT, OFF_PATH, RECOVERY
from splatpilot.training.corpus.shard import OtherVersionError, Shard
from splatpilot.training.corpus.world_record import WorldRecord, WorldSource


@holds_folder("out")
def run(*, config: CorpusConfig, out: Path, worlds: int, jobs: int | None = None) -> Corpus:
    """
    Gathers what a corpus in `out` lacks of its first `worlds` worlds.

    Interrupted, even by `kill -9`, the same command goes on and leaves the same bytes. With more
    worlds it adds to what is there. A shard that is damaged is gathered again.

    Args:
        config: how; it decides every sample.
        out: folder; see `splatpilot.training.corpus.corpus`.
        worlds: in how many worlds.
        jobs: worker processes; one for each core by default.

    Returns:
        The corpus.

    Raises:
        FileNotFoundError, ValueError: on a config out of range, another corpus in `out`, a shard
            of another version, or if nothing was gathered.
        OSError: if `out` cannot be written, or a worker process dies.
    """
    config.validate()
    jobs = available_cores() if jobs is None else jobs
    require(jobs >= 1, "--jobs", "at least 1", jobs)
    require(worlds >= 1, "--worlds", "at least 1", worlds)
    sources = [world_source(config.worlds, config.seed, k) for k in range(worlds)]
    claim_folder(out / CONFIG, config)
    for part in ("worlds", "shards"):
        require_writable_folder(out / part)
    there = [k for k in range(worlds) if shard_folder(out, sources[k].name).exists()]
    checked = Progress(there, "checking worlds", unit="world", leave=False, delay=1.0)
    damage = {k: reason for k in checked if (reason := _damage(out, sources[k], config))}
    missing = sorted(set(range(worlds)) - set(there) | set(damage))
    program = revision()
    if missing:
        _require_same_program(out, program)
    for k in missing:
        if k in damage:
            say(f"{damage[k]}: {sources[k].name} is collected again")
        _remove(out, sources[k].name)
    gather = partial(_gather, out, config, program)
    bar = Progress(total=worlds, initial=worlds - len(missing), desc="collecting", unit="world")

    def kept() -> str:
        return f"{bar.n} of {worlds} worlds are in {out}; the same command resumes there"

    with bar, resumable(kept):
        for reason in map_processes(gather, missing, jobs):
            if reason:
                say(reason)
            bar.update()
    corpus = Corpus(out)
    write_ledger(out, corpus)
    return corpus


def _damage(out: Path, source: WorldSource, config: CorpusConfig) -> str:
    """Tells what is wrong with a world of which there is a shard; empty if nothing is.

    Raises:
        ValueError: if it is of another version, or was made of another definition.
    """
    try:
        record = WorldRecord(out / "worlds" / source.name)
        record.esdf()
        Shard(shard_folder(out, source.name)).verify()
        if config.off_path:
            Shard(shard_folder(out, source.name, OFF_PATH)).verify()
    except OtherVersionError:
        raise
    except (ValueError, FileNotFoundError) as error:
        return str(error)
    if record.source.world != source.world:
        raise ValueError(
            f"{record.path} is a world of another definition than the configuration gives now: the "
            "file of its kind has changed; restore that, or choose another --out"
        )
    return ""


def _require_same_program(out: Path, program: str) -> None:
    """Raises ValueError if another program collected what is there, except for recovery."""
    for path in entries(out / "shards"):
        try:
            shard = Shard(path)
        except ValueError:  # it is damaged
            continue
        if shard.source != RECOVERY and shard.revision != program:
            raise ValueError(
                f"{shard.path} was collected by revision {shard.revision} of the program, this is "
                f"{program}, and one corpus is collected by one program; go back to that revision, "
                "or collect more worlds with another seed in another --out"
            )


def _remove(out: Path, world: str) -> None:
    """Removes what an interruption or damage has left of a world."""
    shutil.rmtree(out / "worlds" / world, ignore_errors=True)
    for source in (OFF_PATH, EXPERT):
        shutil.rmtree(shard_folder(out, world, source), ignore_errors=True)


def _gather(out: Path, config: CorpusConfig, revision: str, index: int) -> str:
    """Gathers a world; returns why not, if it cannot be flown in."""
    try:
        gather_world(out, config, index, revision)
    except InfeasibleFlightError as error:
        return f"world {index} is left out: {error}"
    return ""
