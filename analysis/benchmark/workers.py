"""Where the flights of a study are flown: worker processes here, or on a cluster."""

import functools
from collections.abc import Callable, Generator, Iterable, Iterator
from itertools import chain

from splatpilot.analysis.benchmark.rollout import Fault, Rollout, chunks, fly_rollouts
from splatpilot.analysis.benchmark.study import RolloutSpec
from splatpilot.diagrams.policies import POLICIES
from splatpilot.diagrams.scenario import Scenario
from splatpilot.diagrams.sensors import SENSORS
from splatpilot.diagrams.worlds.make_world import WORLDS
from splatpilot.systems.configuration import dump_config
from splatpilot.systems.extras import import_extra
from splatpilot.systems.processes import map_processes

CONNECT_TIMEOUT = 10.0
"""[s], for a scheduler to answer."""

_CHUNK = 6
"""Most flights through one place handed out together: what of a kill is flown again."""

_Chunk = list[tuple[RolloutSpec, str]]
_Work = Iterator[_Chunk]
_Fly = Callable[[_Chunk], list[Rollout | Fault]]


def fly_all(
    flights: Iterable[tuple[RolloutSpec, Scenario]], jobs: int, cluster: str | None = None
) -> Generator[Rollout | Fault, None, None]:
    """
    Flies rollouts in worker processes and yields them as they end, in any order.

    Args:
        flights: what to fly; neighbours through the same place are flown by the same worker.
        jobs: worker processes on this machine, 1 or more.
        cluster: address of a dask scheduler, whose workers fly instead.

    Raises:
        ModuleNotFoundError: a cluster is wanted and dask.distributed is not installed.
        OSError: if a worker process dies, or the cluster cannot be reached; all that was yielded
            before is good.
    """
    modules = sorted(POLICIES.modules() | WORLDS.modules() | SENSORS.modules())
    found = [name for name in POLICIES.registered() if ":" in name]
    fly = functools.partial(fly_rollouts, modules=modules, policies=found)
    work = chunks(((spec, dump_config(scenario)) for spec, scenario in flights), _CHUNK)
    if cluster is not None:
        yield from _on_cluster(fly, work, cluster)
        return
    yield from chain.from_iterable(map_processes(fly, work, jobs))


def _on_cluster(fly: _Fly, work: _Work, address: str) -> Iterator[Rollout | Fault]:
    distributed = import_extra("distributed", "cluster")
    try:
        client = distributed.Client(address, timeout=CONNECT_TIMEOUT)
    except (OSError, TimeoutError, ValueError) as error:
        raise OSError(
            f"no dask scheduler answers at {address} ({error}); start one with `dask scheduler` "
            "and workers with `dask worker ADDRESS --nthreads 1`"
        ) from None
    with client:
        # A chunk whose worker dies is given to another; flights are pure, so that costs only time.
        futures = client.map(fly, list(work), pure=False, retries=3)
        try:
            for _, rollouts in distributed.as_completed(futures, with_results=True):
                yield from rollouts
        except distributed.KilledWorker as error:
            raise OSError(
                f"the cluster's workers die of one and the same work ({error}); what was flown is "
                "kept: give them more memory and run the same command again"
            ) from None
