import os
import random
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pyarrow.parquet as pq
import pytest

from studies.campaign import read_run, resume, run_study, summarise_again
from studies.study import StudyError
from tests.studies.driver import slow_study

RUNS = 200
DRIVER = Path(__file__).with_name("driver.py")


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The campaign flown in one process, without interruption."""
    folder = tmp_path_factory.mktemp("serial")
    study = slow_study()
    assert run_study(study, folder, RUNS, workers=0, progress=False).complete
    return folder


@pytest.fixture
def start(tmp_path: Path) -> Iterator:
    """Start the driver on a folder; whatever is still there at the end is killed."""
    started: list[subprocess.Popen] = []

    def start(workers: int = 2) -> subprocess.Popen:
        command = [sys.executable, str(DRIVER), str(tmp_path), str(workers), str(RUNS)]
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()


def _wait(condition, seconds: float = 20.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it did not happen in time"
        time.sleep(0.01)


def _kill_a_worker_then_the_parent(
    parent: subprocess.Popen, folder: Path, chance: random.Random
) -> None:
    before = _shards(folder)
    family = psutil.Process(parent.pid)
    _wait(lambda: len(_workers(family)) == 2)
    time.sleep(chance.uniform(0.0, 0.3))
    chance.choice(_workers(family)).kill()
    _wait(lambda: _shards(folder) > before)
    time.sleep(chance.uniform(0.0, 0.2))
    workers = _workers(family)
    parent.kill()
    parent.wait()
    _, alive = psutil.wait_procs(workers, timeout=5.0)
    assert not alive, "a worker outlived its parent"


def _workers(family: psutil.Process) -> list[psutil.Process]:
    return [
        child for child in family.children() if "resource_tracker" not in " ".join(child.cmdline())
    ]


def _shards(folder: Path) -> int:
    return len(list((folder / "shards").glob("*.parquet")))


def _same(folder: Path, reference: Path) -> bool:
    return (folder / "runs.parquet").read_bytes() == (reference / "runs.parquet").read_bytes()


def test_two_processes_fly_the_same_bytes_as_one(reference: Path, tmp_path: Path):
    assert run_study(slow_study(), tmp_path, RUNS, workers=2, progress=False).complete
    assert _same(tmp_path, reference)


def test_a_campaign_that_grew_has_the_bytes_of_one_flown_at_once(reference: Path, tmp_path: Path):
    assert run_study(slow_study(), tmp_path, 100, workers=0, progress=False).done == 100
    assert not _same(tmp_path, reference)
    assert run_study(slow_study(), tmp_path, RUNS, workers=0, progress=False).done == RUNS
    assert _same(tmp_path, reference)


@pytest.mark.slow
def test_kill_9_of_workers_and_parents_loses_no_run_and_doubles_none(
    reference: Path, tmp_path: Path, start
):
    """Three campaigns are killed, each after a worker of its own; then the rest is flown."""
    chance = random.Random(9)
    for _ in range(3):
        _kill_a_worker_then_the_parent(start(), tmp_path, chance)
    with sqlite3.connect(tmp_path / "ledger.sqlite") as ledger:
        (entered,) = ledger.execute("SELECT count(*) FROM runs").fetchone()
    ledger.close()
    assert 0 < entered < RUNS
    assert resume(tmp_path, workers=2, progress=False).complete
    assert _same(tmp_path, reference)
    assert pq.read_table(tmp_path / "runs.parquet")["run"].to_pylist() == list(range(RUNS))
    assert pq.read_table(tmp_path / "timings.parquet")["run"].to_pylist() == list(range(RUNS))


@pytest.mark.parametrize("workers", [0, 2])
def test_ctrl_c_leaves_everything_finished_so_far(
    reference: Path, tmp_path: Path, start, workers: int
):
    process = start(workers)
    _wait(lambda: _shards(tmp_path) > 0)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60.0)
    state, done = out.split()
    assert process.returncode == 0, err
    assert err == ""
    assert (state, 0 < int(done) < RUNS) == ("partial", True)
    partial = pq.read_table(tmp_path / "runs.parquet")
    assert partial.num_rows == int(done)
    assert f"{RUNS - int(done)} more are not flown yet" in (tmp_path / "summary.md").read_text()
    assert resume(tmp_path, workers=0, progress=False).complete
    assert _same(tmp_path, reference)


def test_a_signal_handler_of_others_is_put_back(tmp_path: Path):
    before = signal.getsignal(signal.SIGINT)
    run_study(slow_study(), tmp_path, 2, workers=0, progress=False)
    assert signal.getsignal(signal.SIGINT) is before


def test_summary_and_report_are_the_same_bytes_twice(reference: Path):
    names = ("summary.json", "summary.md", "report.html", "runs.parquet")
    first = [(reference / name).read_bytes() for name in names]
    for name in names:
        (reference / name).unlink()
    summarise_again(reference)
    assert [(reference / name).read_bytes() for name in names] == first


def test_a_single_run_can_be_read_back_and_repeated(reference: Path):
    study, spec = read_run(reference / "101")
    row = pq.read_table(reference / "runs.parquet").to_pylist()[101]
    assert (spec.run, spec.seed, spec.condition.variant) == (101, row["seed"], "wide")
    from tests.studies.toy import Toy

    toy = Toy()
    toy.prepare(study)
    assert toy.run(spec.overrides, spec.seed)["landing_error_m"] == row["landing_error_m"]
    with pytest.raises(StudyError, match="runs 0 to 199, but no 200"):
        read_run(reference / "200")
    with pytest.raises(StudyError, match="expected FOLDER/NUMBER"):
        read_run(reference)


def test_the_table_has_one_row_a_run(reference: Path):
    result = summarise_again(reference)
    assert len(result.table) == RUNS
    assert set(result.table.variant) == {"narrow", "wide"}
    assert os.path.getsize(reference / "report.html") > 10_000


@pytest.mark.parametrize(("runs", "workers"), [(0, 0), (1, -1)])
def test_impossible_numbers_are_refused(tmp_path: Path, runs: int, workers: int):
    with pytest.raises(StudyError, match="expected"):
        run_study(slow_study(), tmp_path, runs, workers=workers, progress=False)


def test_trials_that_nobody_published_are_found_before_the_first_run(tmp_path: Path):
    study = slow_study()
    study.variants["wide"].published = "infrared-and-marker/18"
    with pytest.raises(StudyError, match=r"variants\.wide\.published: .* nearest is infrared-an"):
        run_study(study, tmp_path / "out", progress=False)
    assert not (tmp_path / "out").exists()
