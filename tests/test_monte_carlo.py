"""Many runs: the same numbers wherever they run, and what a cluster that is not there is told."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from magfusion.errors import EstimationError, InputError
from magfusion.simulation.monte_carlo import run_many


def draw(scale: float, rng: np.random.Generator) -> tuple[float, int, str | None]:
    return scale * rng.normal(), os.getpid(), os.environ.get("OMP_NUM_THREADS")


def fail(which: int, rng: np.random.Generator) -> int:
    if which == 2:
        raise ValueError(f"run {which} of seed {rng.integers(10)}")
    return which


def same(scale: float, rng: np.random.Generator) -> float:
    return scale * rng.normal()


# Dask serves its state by HTTP in any case; its usual port may be taken.
ANY = "127.0.0.1:0"
INPUTS = [1.0, 10.0, 1.0, 1e3, 1e4]


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, host="127.0.0.1", dashboard_address=ANY
    ) as started:
        yield started.scheduler_address


def test_results_come_in_order_and_depend_on_the_seed_alone() -> None:
    here = run_many(same, INPUTS, seed=3, workers=1)
    assert here[0] != here[2]  # equal inputs, each with draws of its own
    assert run_many(same, INPUTS, seed=3, workers=2) == here
    assert run_many(same, INPUTS, seed=4, workers=1) != here
    assert run_many(same, INPUTS[:2], seed=3, workers=1) == here[:2]


def test_the_work_is_done_by_other_processes_with_one_thread_each() -> None:
    before = os.environ.get("OMP_NUM_THREADS")
    result = run_many(draw, INPUTS, workers=2)
    assert os.getpid() not in {pid for _, pid, _ in result}
    assert {threads for _, _, threads in result} == {"1"}
    assert os.environ.get("OMP_NUM_THREADS") == before


def test_a_cluster_gives_the_same_numbers(cluster: str) -> None:
    result = run_many(draw, INPUTS, seed=3, cluster=cluster)
    assert [value for value, _, _ in result] == run_many(same, INPUTS, seed=3, workers=1)
    assert os.getpid() not in {pid for _, pid, _ in result}


@pytest.mark.parametrize("where", ["here", "processes", "cluster"])
def test_progress_is_told(where: str, cluster: str) -> None:
    reported: list[tuple[str, int, int]] = []
    place = {"here": {"workers": 1}, "processes": {"workers": 2}, "cluster": {"cluster": cluster}}
    run_many(same, INPUTS, report=lambda *stage: reported.append(stage), **place[where])
    assert reported == [("runs", done, 5) for done in range(6)]


def test_no_inputs_give_no_results() -> None:
    assert run_many(same, []) == []


def test_a_task_that_fails_is_told_as_it_failed(cluster: str) -> None:
    for where in ({"workers": 1}, {"workers": 2}, {"cluster": cluster}):
        with pytest.raises(ValueError, match="run 2 of seed"):
            run_many(fail, range(5), **where)


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "nonsense", "http://127.0.0.1:9"])
def test_a_cluster_that_does_not_answer_is_named(
    address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("magfusion.simulation.monte_carlo.CONNECT_S", 0.5)
    with pytest.raises(InputError, match=f"--cluster {address}"):
        run_many(same, INPUTS, cluster=address)


def test_a_cluster_without_workers_is_told_so(monkeypatch: pytest.MonkeyPatch) -> None:
    distributed = pytest.importorskip("distributed")
    monkeypatch.setattr("magfusion.simulation.monte_carlo.CONNECT_S", 0.5)
    with (
        distributed.LocalCluster(n_workers=0, processes=False, dashboard_address=ANY) as empty,
        pytest.raises(InputError, match="has no workers"),
    ):
        run_many(same, INPUTS, cluster=empty.scheduler_address)


@contextmanager
def _processes() -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Yield what starts a process with its messages in a pipe; none outlives the test."""
    started: list[subprocess.Popen[str]] = []

    def start(*words: str) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, "-m", *words], stderr=subprocess.PIPE, text=True
        )
        started.append(process)
        return process

    try:
        yield start
    finally:
        for process in started:
            process.kill()
            process.communicate()


def _line(process: subprocess.Popen[str], words: str) -> str:
    """Return the next message with these words."""
    assert process.stderr is not None
    return next(line for line in process.stderr if words in line)


def _scheduler(
    start: Callable[..., subprocess.Popen[str]],
) -> tuple[subprocess.Popen[str], str, tuple[str, ...]]:
    """Return a scheduler, its address, and the words that start a worker."""
    pytest.importorskip("distributed")
    plain = ("--host", "127.0.0.1", "--no-dashboard")
    scheduler = start("dask", "scheduler", *plain, "--port", "0", "--no-show")
    address = _line(scheduler, "Scheduler at:").split()[-1]
    return scheduler, address, ("dask", "worker", address, *plain, "--no-nanny", "--nthreads", "1")


@pytest.mark.slow
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_command_whose_last_worker_is_killed_says_so_and_ends_at_once(
    number: signal.Signals, code: int, tmp_path: Path
) -> None:
    if signal.getsignal(number) is signal.SIG_IGN:
        pytest.skip("a background job ignores SIGINT")
    with _processes() as start:
        scheduler, address, worker_words = _scheduler(start)
        worker, place = start(*worker_words), str(tmp_path / "drift")
        _line(worker, "Registered to")
        words = ("drift", "--hours", "200", "--estimator", "ekf", "--cluster", address, "-o", place)
        command = start("magfusion", *words)
        _line(scheduler, "Receive client connection: Client-")
        time.sleep(2.0)  # s; the task begins
        worker.kill()
        killed = time.monotonic()
        assert address in _line(command, "no worker is left")
        assert time.monotonic() - killed < 10.0
        command.send_signal(number)
        sent = time.monotonic()
        assert command.wait(60.0) == code
        assert time.monotonic() - sent < 5.0


def nap(seconds: float, rng: np.random.Generator) -> float:
    time.sleep(seconds)
    return rng.normal()


@pytest.mark.slow
def test_tasks_wait_for_another_worker(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(Path(__file__).parent), *sys.path]))
    monkeypatch.setattr("magfusion.simulation.monte_carlo.WATCH_S", 0.2)
    with _processes() as start:
        _, address, worker_words = _scheduler(start)
        first = start(*worker_words)
        _line(first, "Registered to")

        def replace_worker(_stage: str, done: int, _total: int) -> None:
            if done == 1 and first.poll() is None:
                first.kill()
                time.sleep(1.0)
                start(*worker_words)

        result = run_many(nap, [0.5] * 3, cluster=address, report=replace_worker)
    assert result == run_many(nap, [0.0] * 3, workers=1)
    assert capsys.readouterr().err.count("no worker is left") == 1


def quit_once(given: tuple[Path, bool], rng: np.random.Generator) -> float:
    mark, dies = given
    if dies and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return rng.normal()


@pytest.mark.slow
def test_results_that_a_worker_takes_with_it_are_computed_again(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    distributed = pytest.importorskip("distributed")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(Path(__file__).parent), *sys.path]))
    inputs = [(tmp_path / f"{i}", i % 20 == 19) for i in range(100)]
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, host="127.0.0.1", dashboard_address=ANY
    ) as started:
        result = run_many(quit_once, inputs, cluster=started.scheduler_address)
    assert sum(mark.exists() for mark, _ in inputs) == 5
    assert result == run_many(quit_once, inputs, workers=1)


@pytest.mark.slow
def test_a_scheduler_that_ends_is_named() -> None:
    distributed = pytest.importorskip("distributed")
    started = distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=True, host="127.0.0.1", dashboard_address=ANY
    )
    with pytest.raises(EstimationError, match=f"{started.scheduler_address}: the scheduler has"):
        run_many(
            nap,
            [0.2, 60.0],
            cluster=started.scheduler_address,
            report=lambda _stage, done, _total: started.close() if done else None,
        )


@pytest.mark.slow
def test_dask_that_is_missing_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"pip install 'magfusion\[cluster\]'"):
        run_many(same, INPUTS, cluster="tcp://127.0.0.1:9")


@pytest.mark.slow
def test_no_workers_are_refused() -> None:
    with pytest.raises(InputError, match="--workers must be at least 1"):
        run_many(same, INPUTS, workers=0)
