import errno
import os
import sqlite3
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from studies import ledger as ledger_module
from studies.executors import SerialExecutor, execute, fly_chunk
from studies.ledger import Ledger
from studies.study import Study, StudyError, Variant


@pytest.fixture
def study() -> Study:
    return Study(
        name="toy",
        scenario="toy",
        experiment="tests.studies.toy:Toy",
        variants={"narrow": Variant(), "wide": Variant(overrides={"toy.spread": 0.3})},
        grids={"toy.wind": [0, 1.5]},
    )


def fly(study: Study, *runs: int):
    return fly_chunk(study, runs).rows


def test_rows_are_sorted_whatever_the_order_they_came_in(study: Study, tmp_path: Path):
    tables = []
    for name, chunks in (("a", [[0, 1, 2, 3, 4, 5]]), ("b", [[4, 5], [0], [2, 3], [1]])):
        with Ledger.create(tmp_path / name, study, 6) as ledger:
            for chunk in chunks:
                ledger.commit(fly(study, *chunk))
            assert ledger.done() == set(range(6))
            ledger.finish()
        tables.append((tmp_path / name / "runs.parquet").read_bytes())
    assert tables[0] == tables[1]
    runs = pq.read_table(tmp_path / "a/runs.parquet")
    assert runs["run"].to_pylist() == list(range(6))
    assert runs.column_names == [
        "run", "pair", "condition", "variant", "toy.wind", "landed", "landing_error_m",
        "landing_x_m", "landing_y_m", "landing_time_s", "attempts", "reason", "seed", "status",
        "failure",
    ]  # fmt: skip


def test_seconds_are_kept_apart(study: Study, tmp_path: Path):
    with Ledger.create(tmp_path, study, 2) as ledger:
        ledger.commit(fly(study, 0, 1))
        ledger.finish()
    timings = pq.read_table(tmp_path / "timings.parquet")
    assert timings.column_names == ["run", "cpu_s", "cpu_seconds", "wall_seconds", "worker"]


def test_a_campaign_without_rows_can_be_finished(study: Study, tmp_path: Path):
    with Ledger.create(tmp_path, study, 2) as ledger:
        assert ledger.finish().num_rows == 0


def test_columns_of_whole_and_broken_numbers_become_one(study: Study, tmp_path: Path):
    rows = fly(study, 0, 1)
    rows[0]["attempts"], rows[1]["attempts"] = 1, 2.5
    with Ledger.create(tmp_path, study, 2) as ledger:
        ledger.commit(rows[:1])
        ledger.commit(rows[1:])
        assert ledger.finish()["attempts"].to_pylist() == [1.0, 2.5]


@pytest.mark.parametrize("together", [True, False])
def test_a_column_of_numbers_and_texts_is_refused(study: Study, tmp_path: Path, together: bool):
    rows = fly(study, 0, 1)
    rows[1]["attempts"] = "two"
    chunks = [rows] if together else [rows[:1], rows[1:]]

    def keep(ledger: Ledger) -> None:
        for chunk in chunks:
            ledger.commit(chunk)
        ledger.finish()

    with (
        Ledger.create(tmp_path, study, 2) as ledger,
        pytest.raises(StudyError, match="mixes kinds of values"),
    ):
        keep(ledger)


def test_a_run_is_never_entered_twice(study: Study, tmp_path: Path):
    with Ledger.create(tmp_path, study, 4) as ledger:
        ledger.commit(fly(study, 0, 1))
        with pytest.raises(StudyError, match="entered twice"):
            ledger.commit(fly(study, 1, 2))
        assert ledger.done() == {0, 1}
    with Ledger.open(tmp_path) as ledger:  # and the shard of the refused rows is gone
        assert ledger.table()["run"].to_pylist() == [0, 1]


def test_lost_and_damaged_shards_are_flown_again(study: Study, tmp_path: Path):
    with Ledger.create(tmp_path, study, 6) as ledger:
        for chunk in ([0, 1], [2, 3], [4, 5]):
            ledger.commit(fly(study, *chunk))
    first, second, _ = sorted((tmp_path / "shards").iterdir())
    first.unlink()
    second.write_bytes(second.read_bytes()[:-1] + b"?")
    (tmp_path / "shards" / ".half.parquet.part").write_bytes(b"PAR1")
    with Ledger.open(tmp_path) as ledger:
        assert ledger.done() == {4, 5}
        assert len(list((tmp_path / "shards").iterdir())) == 1


def test_only_one_campaign_at_a_time_writes_a_folder(study: Study, tmp_path: Path):
    with (
        Ledger.create(tmp_path, study, 2),
        pytest.raises(StudyError, match="is in use by another campaign"),
    ):
        Ledger.open(tmp_path)
    Ledger.open(tmp_path).close()


def test_another_study_or_seed_does_not_mix_in(study: Study, tmp_path: Path):
    Ledger.create(tmp_path, study, 2).close()
    study.seed = 8
    with pytest.raises(StudyError, match="another campaign of the study toy"):
        Ledger.create(tmp_path, study, 2)


def test_other_code_does_not_mix_in_unasked(study: Study, tmp_path: Path, monkeypatch):
    with Ledger.create(tmp_path, study, 2) as ledger:
        ledger.require_same_provenance()
    other = ledger_module.provenance() | {"drake": "0.1"}
    monkeypatch.setattr(ledger_module, "provenance", lambda: other)
    with Ledger.open(tmp_path) as ledger:
        with pytest.raises(StudyError, match=r"other code \(drake .* \(here 0.1\) differs\)"):
            ledger.require_same_provenance()
        ledger.accept_provenance()
        ledger.require_same_provenance()


def test_a_campaign_killed_before_it_began_begins_anew(study: Study, tmp_path: Path):
    sqlite3.connect(tmp_path / "ledger.sqlite").close()
    (tmp_path / "ledger.sqlite").touch()
    with pytest.raises(StudyError, match="killed before it began"):
        Ledger.open(tmp_path)
    with Ledger.create(tmp_path, study, 2) as ledger:
        assert ledger.runs == 2


@pytest.mark.parametrize("place", ["file/out", "/proc/plumbline"])
def test_a_folder_that_cannot_be_made_is_one_sentence(study: Study, tmp_path: Path, place: str):
    (tmp_path / "file").touch()
    with pytest.raises(StudyError, match="cannot be made a folder for a campaign: "):
        Ledger.create(tmp_path / place, study, 2)


def test_a_folder_without_a_campaign_is_one_sentence(tmp_path: Path):
    with pytest.raises(StudyError, match="there is no campaign here"):
        Ledger.open(tmp_path)


def test_a_file_that_is_no_ledger_is_one_sentence(tmp_path: Path):
    (tmp_path / "ledger.sqlite").write_bytes(b"not a database, but long enough to look" * 50)
    with pytest.raises(StudyError, match=r"ledger.sqlite cannot be used: file is not a database"):
        Ledger.open(tmp_path)


def test_a_full_disk_keeps_what_is_entered(study: Study, tmp_path: Path, monkeypatch):
    """The disk fills up while the third shard is written."""
    flush, calls = os.fsync, []

    def fsync(descriptor: int) -> None:
        calls.append(descriptor)
        if len(calls) == 5:  # a file and its folder for each shard
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        flush(descriptor)

    with Ledger.create(tmp_path, study, 8) as ledger:
        monkeypatch.setattr(os, "fsync", fsync)
        ledger.commit(fly(study, 0, 1))
        ledger.commit(fly(study, 2, 3))
        with pytest.raises(StudyError, match="no space left on the disk; every run entered"):
            ledger.commit(fly(study, 4, 5))
        monkeypatch.undo()
    assert not list((tmp_path / "shards").glob(".*"))
    with Ledger.open(tmp_path) as ledger:
        assert ledger.done() == {0, 1, 2, 3}
        left = [4, 5, 6, 7]
        execute(SerialExecutor(), study, left, ledger.commit)
        assert ledger.table()["run"].to_pylist() == list(range(8))
