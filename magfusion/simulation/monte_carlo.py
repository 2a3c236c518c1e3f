"""Parallel independent tasks: on all cores of this machine, or on a Dask cluster."""

import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, Executor, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from threading import Event, Thread
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from magfusion.errors import EstimationError, InputError
from magfusion.files.blas_threads import OF_ALL, THREADS

if TYPE_CHECKING:
    from distributed import Client

Input = TypeVar("Input")
Output = TypeVar("Output")
Report = Callable[[str, int, int], None]  # stage, done, total

CONNECT_S = 10.0  # patience with a cluster, s
WATCH_S = 2.0  # s, from one look at its workers to the next
# A worker has one core: more threads of linear algebra would compete for it.
_ONE_THREAD = (OF_ALL, *THREADS)


def run_many(
    task: Callable[[Input, np.random.Generator], Output],
    inputs: Sequence[Input],
    *,
    seed: int = 0,
    cluster: str | None = None,
    workers: int | None = None,
    report: Report | None = None,
) -> list[Output]:
    """Run a task on every input, each with its own random generator.

    The generators are spawned from ``seed`` by the index of the input, so that results depend
    neither on the number of workers nor on where they run.

    Parameters
    ----------
    task : callable
        Function of an input and a Generator, defined at the top of a module; a block of runs in
        one call reduces the overhead.
    inputs : sequence
    cluster : str, optional
        Address of a Dask scheduler (``tcp://host:8786``) whose workers have magfusion installed.
    workers : int, optional
        Processes on this machine, all cores by default; one runs the tasks in this process.
    report : callable, optional
        Called with the stage, the number of finished tasks and of all tasks.

    Returns
    -------
    list
        In the order of ``inputs``.

    Raises
    ------
    InputError
        Where the cluster cannot be used, or ``workers`` is below one.
    EstimationError
        Where a process of this machine was killed.
    """
    with worker_pool(len(inputs), cluster=cluster, workers=workers) as hands:
        return hands.run(task, inputs, seed=seed, report=report)


@dataclass(frozen=True)
class WorkerPool:
    """Processes that persist over several calls, so that they are started once."""

    executor: "Executor | Client | None"  # None runs the tasks in this process

    def run(
        self,
        task: Callable[[Input, np.random.Generator], Output],
        inputs: Sequence[Input],
        *,
        seed: int = 0,
        report: Report | None = None,
    ) -> list[Output]:
        """Run a task on every input; see `run_many`."""
        report_progress = report or (lambda _stage, _done, _total: None)
        seeds = np.random.SeedSequence(seed).spawn(len(inputs))
        given = list(zip(inputs, seeds, strict=True))
        if self.executor is None:
            return list(_here(task, given, report_progress))
        return _gather(self.executor, task, given, report_progress)


@contextmanager
def worker_pool(
    maximum: int, *, cluster: str | None = None, workers: int | None = None
) -> Iterator[WorkerPool]:
    """Yield an executor of tasks: this process, others of this machine, or a Dask cluster.

    `maximum`: maximum number of concurrent tasks. `cluster`, `workers`: as of `run_many`. Raises
    InputError where the cluster cannot be used, or ``workers`` is below one.
    """
    if workers is not None and workers < 1:
        raise InputError(f"--workers must be at least 1; got {workers}")
    count = min(workers or len(os.sched_getaffinity(0)), maximum)
    if cluster is None and count <= 1:
        yield WorkerPool(None)
        return
    with _processes(count) if cluster is None else _dask(cluster) as executor:
        yield WorkerPool(executor)


def _run(
    task: Callable[[Input, np.random.Generator], Output], one: Input, seed: np.random.SeedSequence
) -> Output:
    return task(one, np.random.default_rng(seed))


def _here(
    task: Callable[[Any, np.random.Generator], Output],
    given: list[tuple[Any, np.random.SeedSequence]],
    report_progress: Report,
) -> Iterator[Output]:
    report_progress("runs", 0, len(given))
    for done, (one, seed) in enumerate(given, start=1):
        yield _run(task, one, seed)
        report_progress("runs", done, len(given))


def _gather(
    executor: "Executor | Client",
    task: Callable[[Any, np.random.Generator], Output],
    given: list[tuple[Any, np.random.SeedSequence]],
    report_progress: Report,
) -> list[Output]:
    submit, completed = _interface(executor)
    futures = [submit(_run, task, one, seed) for one, seed in given]
    report_progress("runs", 0, len(futures))
    results: dict[Any, Output] = {}
    try:
        for future in completed(futures):
            results[future] = future.result()
            report_progress("runs", len(results), len(futures))
    except BaseException:
        for future in futures:
            future.cancel()
        raise
    return [results[future] for future in futures]


def _interface(executor: "Executor | Client") -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Return how tasks are submitted, and iterated over as they are completed."""
    if isinstance(executor, Executor):
        return executor.submit, as_completed
    # Not by Client.get_executor(), which fails where a result is lost with its worker.
    from distributed import as_completed as completed_on_cluster

    submit = partial(executor.submit, pure=False)  # equal inputs are separate runs
    return submit, partial(completed_on_cluster, loop=executor.loop)


def _end_with_parent() -> None:
    """End this worker as soon as its parent has ended, even if that was killed."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)

    Thread(target=watch, daemon=True).start()


@contextmanager
def _processes(count: int) -> Iterator[Executor]:
    # Spawned, not forked: a fork copies the locks of other threads in their current state.
    context = multiprocessing.get_context("spawn")
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    try:
        with ProcessPoolExecutor(count, context, initializer=_end_with_parent) as executor:
            yield executor
    except BrokenProcessPool as error:
        raise EstimationError(
            "a worker process was killed, possibly for lack of memory; reduce --workers"
        ) from error
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def _dask(address: str) -> Iterator["Client"]:
    try:
        from distributed import Client
        from distributed.scheduler import KilledWorker, NoWorkerError
    except ImportError as error:
        raise InputError(
            f"--cluster {address}: dask is not installed; pip install 'magfusion[cluster]'"
        ) from error
    try:
        client = Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise InputError(
            f"--cluster {address}: no Dask scheduler responds; start one with dask scheduler, and"
            " give the address that it prints"
        ) from error
    with client:
        try:
            client.wait_for_workers(1, timeout=CONNECT_S)
        except TimeoutError as error:
            raise InputError(
                f"--cluster {address}: the scheduler has no workers; start some with dask worker"
                f" {address}"
            ) from error
        ended = Event()
        Thread(target=_report_loss, args=(client, address, ended), daemon=True).start()
        try:
            yield client
        except (KilledWorker, NoWorkerError) as error:
            raise EstimationError(
                f"--cluster {address}: its workers have ended, possibly for lack of memory; start"
                " them again, with more memory each"
            ) from error
        except CancelledError as error:
            raise EstimationError(
                f"--cluster {address}: the scheduler has ended; start it and its workers again"
            ) from error
        finally:
            ended.set()


def _report_loss(client: "Client", address: str, ended: Event) -> None:
    """Write once, until there is one again, that no worker is left."""
    worked = True
    while not ended.wait(WATCH_S):
        before = worked
        with suppress(OSError, ValueError):  # a client that has no scheduler ends by itself
            worked = bool(client.nthreads())
        if before and not worked:
            sys.stderr.write(
                f"magfusion: --cluster {address}: no worker is left; the tasks wait for one. Start"
                f" dask worker {address}, or end this run by Ctrl-C.\n"
            )
