"""Gathering a corpus, in any number of worlds side by side."""

import shutil
from functools import partial
from pathlib import Path

from tqdm import tqdm

from splatpilot.systems.cores import available_cores
from splatpilot.systems.files import require_writable_folder
from splatpilot.systems.infeasible import InfeasibleFlightError
from splatpilot.systems.messages import require
from splatpilot.systems.output_folders import claim_folder, holds_folder
from splatpilot.systems.processes import map_processes
from splatpilot.systems.provenance import revision
from splatpilot.training.corpus.config import CorpusConfig
from splatpilot.training.corpus.corpus import CONFIG, Corpus
from splatpilot.training.corpus.gather import gather_world, shard_folder
from splatpilot.training.corpus.ledger import write_ledger
from splatpilot.training.corpus.library import world_source
from splatpilot.training.corpus.sample import OFF_PATH
from splatpilot.training.corpus.shard import OtherVersionError, Shard
from splatpilot.training.corpus.world_record import WorldRecord


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
    names = [world_source(config.worlds, config.seed, k).name for k in range(worlds)]
    claim_folder(out / CONFIG, config)
    for part in ("worlds", "shards"):
        require_writable_folder(out / part)
    missing = [k for k in range(worlds) if not _is_there(out, names[k], config)]
    gather = partial(_gather, out, config, revision())
    with tqdm(total=worlds, initial=worlds - len(missing), desc="worlds", unit="world") as bar:
        for reason in map_processes(gather, missing, jobs):
            if reason:
                bar.write(reason)
            bar.update()
    corpus = Corpus(out)
    write_ledger(out, corpus)
    return corpus


def _is_there(out: Path, world: str, config: CorpusConfig) -> bool:
    """Whether a world and its shard are there and whole; what is left of them otherwise is
    removed."""
    record, shard = out / "worlds" / world, shard_folder(out, world)
    off_path = shard_folder(out, world, OFF_PATH)
    if not shard.exists():
        return False
    try:
        WorldRecord(record).esdf()
        Shard(shard).verify()
        if config.off_path:
            Shard(off_path).verify()
    except OtherVersionError:
        raise
    except (ValueError, FileNotFoundError) as error:
        tqdm.write(f"{error}: {world} is gathered again")
        shutil.rmtree(record, ignore_errors=True)
        shutil.rmtree(shard)
        shutil.rmtree(off_path, ignore_errors=True)
        return False
    return True


def _gather(out: Path, config: CorpusConfig, revision: str, index: int) -> str:
    """Gathers a world; returns why not, if it cannot be flown in."""
    try:
        gather_world(out, config, index, revision)
    except InfeasibleFlightError as error:
        return f"world {index} is left out: {error}"
    return ""
