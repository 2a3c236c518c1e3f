"""Many runs: the same numbers wherever they run, and what a cluster that is not there is told."""

import os
import sys
from collections.abc import Iterator

import numpy as np
import pytest

from magfusion.errors import InputError
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


def test_dask_that_is_missing_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"pip install 'magfusion\[cluster\]'"):
        run_many(same, INPUTS, cluster="tcp://127.0.0.1:9")


def test_no_workers_are_refused() -> None:
    with pytest.raises(InputError, match="--workers must be at least 1"):
        run_many(same, INPUTS, workers=0)
