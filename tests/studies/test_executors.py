import os
import signal
import threading
import time
from contextlib import closing

import psutil
import pytest

from studies import executors
from studies.executors import (
    MAX_DEATHS,
    DaskExecutor,
    ProcessExecutor,
    SerialExecutor,
    execute,
    fly_chunk,
    make_executor,
)
from studies.sampling import hashed_uniform
from studies.study import Measures, Study, StudyError

VOLATILE = ("cpu_s", "cpu_seconds", "wall_seconds", "worker")


def toy(experiment: str = "Toy", **overrides) -> Study:
    named = {f"toy.{name}": value for name, value in overrides.items()}
    return Study(
        name="toy",
        scenario="toy",
        experiment=f"tests.studies.toy:{experiment}",
        overrides=named,
        measures=Measures(others=["attempts"]),
    )


def fly(executor, study: Study, runs: int, **events) -> list[dict]:
    """All rows without their volatile columns, by run number; each run once."""
    rows: list[dict] = []
    with closing(executor):
        execute(executor, study, range(runs), rows.extend, **events)
    numbers = [row["run"] for row in rows]
    assert len(numbers) == len(set(numbers))
    return [
        {name: value for name, value in row.items() if name not in VOLATILE}
        for row in sorted(rows, key=lambda row: row["run"])
    ]


def test_a_chunk_ends_in_time_but_not_without_a_run():
    study = toy(seconds=0.02)
    assert len(fly_chunk(study, range(50), seconds=0.0).rows) == 1
    assert 2 <= len(fly_chunk(study, range(50), seconds=0.1).rows) < 10


def test_a_failed_run_is_a_row_with_its_reason():
    rows = fly(SerialExecutor(), toy(failures=0.3), 40)
    failed = [row for row in rows if row["status"] == "failed"]
    assert 3 < len(failed) < 25
    for row in failed:
        assert row["failure"] == "ArithmeticError: the filter diverged"
        assert "landing_error_m" not in row
    assert all(row["failure"] == "" for row in rows if row["status"] == "done")


def test_an_experiment_is_prepared_once_a_process():
    study = toy()
    first = executors._experiment(study)
    assert executors._experiment(study) is first
    study.seed = 1
    assert executors._experiment(study) is not first


@pytest.mark.parametrize(
    ("experiment", "expected"),
    [
        ("tests.studies.toy:Unprepared", "cannot be prepared: OSError: no beacon in toy"),
        ("tests.studies.toy:Wordy", "column path is a list"),
        ("tests.studies.toy:Forgetful", "no column landing_time_s, only landed, reason"),
        ("tests.studies.toy:Absent", "has no attribute 'Absent'"),
        ("no_such_module:Toy", "there is no module no_such_module"),
        ("no_colon", "expected module:class"),
    ],
)
@pytest.mark.parametrize("workers", [0, 1])
def test_what_the_experiment_does_wrong_is_one_sentence(experiment, expected, workers):
    study = toy()
    study.experiment = experiment
    with pytest.raises(StudyError, match=expected) as raised:
        fly(make_executor(workers), study, 3)
    assert "\n" not in str(raised.value)


def test_a_run_that_always_kills_its_worker_is_a_failed_row():
    """The others of its chunk are flown, and nobody waits for ever."""
    study = toy(deaths=0.05)
    doomed = {spec.run for spec in study.run_specs(40) if hashed_uniform(spec.seed, "death") < 0.05}
    assert doomed
    rows = fly(ProcessExecutor(2), study, 40)
    assert [row["run"] for row in rows] == list(range(40))
    assert {row["run"] for row in rows if row["status"] == "failed"} == doomed
    reason = f"the worker process died in each of {MAX_DEATHS} attempts"
    assert all(row["failure"] == (reason if row["run"] in doomed else "") for row in rows)


def test_workers_that_never_come_up_end_the_campaign():
    with pytest.raises(StudyError, match="died before any finished a run"):
        fly(ProcessExecutor(2), toy(deaths=1.0), 40)


def test_stopping_brings_home_what_is_in_the_air():
    stopping = threading.Event()
    timer = threading.Timer(3.0, stopping.set)
    timer.start()
    begin = time.monotonic()
    rows = fly(ProcessExecutor(2), toy(seconds=0.05), 1000, stopping=stopping)
    timer.cancel()
    assert time.monotonic() - begin < 5.0
    assert 5 < len(rows) < 200


def test_closing_leaves_no_process_behind():
    before = {child.pid for child in psutil.Process().children(recursive=True)}
    executor = ProcessExecutor(2)
    for _ in range(2):
        executor.submit(toy(seconds=10.0), [0])
    workers = _workers(before, 2)
    executor.close()
    gone, alive = psutil.wait_procs(workers, timeout=5.0)
    assert len(gone) == 2
    assert not alive


def test_a_scheduler_that_is_not_there_is_one_sentence():
    with pytest.raises(StudyError, match=r"no scheduler answers at tcp://127\.0\.0\.1:9"):
        DaskExecutor("tcp://127.0.0.1:9", timeout=0.5)


def test_a_cluster_flies_the_same_rows_though_a_worker_is_killed():
    distributed = pytest.importorskip("distributed")
    study = toy(seconds=0.01, failures=0.05)
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, memory_limit=None
    ) as cluster:
        executor = DaskExecutor(cluster.scheduler_address)
        pids = [worker.pid for worker in cluster.workers.values()]
        killer = threading.Timer(1.0, os.kill, (pids[0], signal.SIGKILL))
        killer.start()
        rows = fly(executor, study, 300)
        killer.join()
        assert not psutil.pid_exists(pids[0])
    assert rows == fly(SerialExecutor(), study, 300)


def test_a_cluster_without_workers_is_not_waited_for_for_ever(monkeypatch):
    distributed = pytest.importorskip("distributed")
    monkeypatch.setattr(executors, "CLUSTER_PATIENCE", 0.5)
    with (
        distributed.LocalCluster(n_workers=0, dashboard_address=None) as cluster,
        pytest.raises(StudyError, match=r"no worker has come for 0\.5 s"),
    ):
        fly(DaskExecutor(cluster.scheduler_address), toy(), 3)


def _workers(before: set[int], count: int) -> list[psutil.Process]:
    deadline = time.monotonic() + 10.0
    while time.monotonic() < deadline:
        workers = [
            child
            for child in psutil.Process().children(recursive=True)
            if child.pid not in before and "resource_tracker" not in " ".join(child.cmdline())
        ]
        if len(workers) == count:
            return workers
        time.sleep(0.05)
    raise AssertionError("the workers have not come")
