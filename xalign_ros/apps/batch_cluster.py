"""The jobs of a batch on Dask: on a cluster of this machine's own, or on one that runs already."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from typing import TypeVar

from xalign_ros.core.errors import ConfigError

DEATHS = 3  # of workers over one job, that it is given another one
PATIENCE_S = 20

Job = TypeVar("Job")
Result = TypeVar("Result")


def on_cluster(
    work: Callable[[Job], Result], jobs: Sequence[Job], names: Sequence[str], workers: int, scheduler: str | None
) -> Iterator[tuple[int, Result | str]]:
    """The result of each job by its place, in the order in which they come, or in words why there is none.

    A job whose worker dies goes to another one. Raises ConfigError where Dask is not installed, or the scheduler does
    not answer or has no workers.
    """
    try:
        import dask
        from distributed import Client, LocalCluster, as_completed
        from distributed.scheduler import KilledWorker
    except ImportError:
        raise ConfigError("several logs, and --scheduler, need Dask: pip install dask distributed") from None
    for name in [name for name in logging.root.manager.loggerDict if name.startswith("distributed")]:
        logging.getLogger(name).setLevel(logging.CRITICAL)  # what they say is told here, in sentences
    settings = {"distributed.scheduler.allowed-failures": DEATHS, "distributed.scheduler.worker-saturation": 1.0}
    with dask.config.set(settings), ExitStack() as stack:
        if scheduler is None:
            cluster = LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                host="127.0.0.1",
                dashboard_address=None,
                memory_limit=0,
                silence_logs=logging.CRITICAL,
            )
            scheduler = stack.enter_context(cluster).scheduler_address
        try:
            client = stack.enter_context(Client(scheduler, timeout=PATIENCE_S, set_as_default=False))
            client.wait_for_workers(1, timeout=PATIENCE_S)
        except (OSError, TimeoutError, ValueError) as error:
            raise ConfigError(f"the scheduler {scheduler} does not answer, or has no workers: {error}") from None
        keys = [f"{n}-{name}" for n, name in enumerate(names)]
        futures = client.map(work, jobs, key=keys)
        place = {future.key: n for n, future in enumerate(futures)}
        for future in as_completed(futures, loop=client.loop):
            found: Result | str
            try:
                found = future.result()
            except KilledWorker:
                found = f"{DEATHS + 1} workers died over it; it may need more memory than they have"
            except Exception as error:  # of the cluster: a job's own are its result
                found = f"the cluster did not finish it: {error or type(error).__name__}"
            yield place[future.key], found
