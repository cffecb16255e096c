"""Who flies the runs: this process, processes of this machine, or a Dask cluster.

An executor flies chunks of runs and may lose some; what is kept, and that it is kept
once, is the ledger's business. A chunk ends after `MAX_CHUNK` runs or
`CHUNK_SECONDS`, whichever comes first, so that little is lost with a worker and
nobody waits for the last one. Neither decides anything about a run.
"""

import concurrent.futures
import importlib
import json
import multiprocessing
import os
import platform
import signal
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any, Protocol

import numpy as np

from studies.ledger import Row
from studies.provenance import provenance
from studies.study import RunSpec, Study, StudyError

MAX_CHUNK = 100  # runs; a shard of 100 rows costs 17 us a run to store, one of 1000 still 5
CHUNK_SECONDS = 5.0  # s of wall time after which a chunk ends with the run in the air
MAX_DEATHS = 4  # a run that alone brings down this many workers is entered as failed
START_DEATHS = 5  # workers in a row that may die before any has finished a run
CLUSTER_PATIENCE = 60.0  # s to wait for a worker to come (back)


class Experiment(Protocol):
    """What a study flies, named by import path, ``module:class``; made without arguments.

    `run` is a pure function of its arguments. A `StudyError` from either method ends
    the campaign; any other exception from `run` is that run's failure.
    """

    def prepare(self, study: Study) -> None:
        """Build whatever all runs share; called once in every process."""

    def run(self, overrides: dict[str, Any], seed: int) -> dict[str, float | int | str | bool]:
        """Fly the study's scenario with overrides by dotted path, and return its columns."""


@dataclass
class Chunk:
    """What a worker sends back: the rows of the first of the runs it was given."""

    rows: list[Row]
    provenance: dict[str, str]


class Executor(Protocol):
    """Flies chunks; a context manager's `close` ends whatever still runs."""

    def slots(self) -> int:
        """How many chunks may fly at once now."""

    def submit(self, study: Study, runs: Sequence[int]) -> "Future[Chunk]":
        """Fly some runs; the future raises `WorkerLostError` if the worker died."""

    def stop(self) -> None:
        """Let chunks in the air end with the run they are in."""

    def close(self) -> None:
        """End all workers now."""


class WorkerLostError(Exception):
    """A worker died with a chunk in the air."""


def make_executor(workers: int, scheduler: str | None = None) -> Executor:
    """The executor for `workers` processes (0: this one) or a Dask scheduler's address."""
    if scheduler is not None:
        return DaskExecutor(scheduler)
    if workers < 0:
        raise StudyError(f"expected 0 or more workers, found {workers}")
    return ProcessExecutor(workers) if workers else SerialExecutor()


def execute(
    executor: Executor,
    study: Study,
    runs: Iterable[int],
    commit: Callable[[list[Row]], None],
    stopping: threading.Event | None = None,
) -> None:
    """Fly `runs` and hand every row to `commit`, chunk by chunk, in this thread.

    Parameters
    ----------
    executor : Executor
        Who flies.
    study : Study
        What.
    runs : iterable of int
        Run numbers.
    commit : callable
        Called with the rows of finished runs; each run comes once.
    stopping : threading.Event, optional
        Once set, nothing new is begun and what is in the air is brought home.

    Raises
    ------
    StudyError
        The experiment cannot be prepared, workers die at their start, the cluster is gone,
        or `commit` raised it.
    """
    waiting = deque(runs)
    alone: deque[int] = deque()  # runs that were in the air when a worker died
    deaths: Counter[int] = Counter()
    airborne: dict[Future[Chunk], list[int]] = {}
    lost_at_start = 0  # workers, before the first that finished a run
    has_flown = False
    last_worker = time.monotonic()  # when there was one
    while waiting or alone or airborne:
        if slots := executor.slots():
            last_worker = time.monotonic()
        elif time.monotonic() - last_worker > CLUSTER_PATIENCE:
            raise StudyError(
                f"no worker has come for {CLUSTER_PATIENCE:g} s; every run entered so far is "
                "kept: start workers and resume"
            )
        if stopping is not None and stopping.is_set():
            if not airborne:
                return
            executor.stop()
        else:
            while len(airborne) < slots and (alone or waiting):
                chunk = [alone.popleft()] if alone else _take(waiting, slots)
                airborne[executor.submit(study, chunk)] = chunk
        # The timeout lets signals in, and workers that join a cluster.
        landed, _ = concurrent.futures.wait(
            airborne, timeout=0.5, return_when=concurrent.futures.FIRST_COMPLETED
        )
        if not airborne:
            time.sleep(0.2)
        for future in landed:
            chunk = airborne.pop(future)
            try:
                result = future.result()
            except (WorkerLostError, BrokenProcessPool):
                lost_at_start += not has_flown
                if lost_at_start >= START_DEATHS:
                    raise StudyError(
                        f"{lost_at_start} worker processes died before any finished a run: fly "
                        "with 0 workers to see why (a script that starts a study needs "
                        "`if __name__ == '__main__':`)"
                    ) from None
                if len(chunk) == 1:
                    deaths.update(chunk)
                if deaths[chunk[0]] < MAX_DEATHS:
                    alone.extend(chunk)
                else:
                    commit([_lost_row(study, chunk[0])])
                continue
            has_flown = True
            _require_provenance(result)
            waiting.extendleft(reversed(chunk[len(result.rows) :]))
            commit(result.rows)


def _take(waiting: deque[int], slots: int) -> list[int]:
    """The next chunk, small enough for everybody to get one."""
    size = min(MAX_CHUNK, -(-len(waiting) // slots))
    return [waiting.popleft() for _ in range(size)]


def fly_chunk(study: Study, runs: Sequence[int], seconds: float = CHUNK_SECONDS) -> Chunk:
    """Fly runs in this process until `seconds` have passed or `stop_flying` is called.

    At least one run is flown; the rest is left to whoever gave them.
    """
    rows: list[Row] = []
    with _one_at_a_time:
        experiment = _experiment(study)
        begin = time.monotonic()
        for run in runs:
            rows.append(_fly(experiment, study, study.run_spec(run)))
            if _stop.is_set() or time.monotonic() - begin > seconds:
                break
    return Chunk(rows, provenance())


def stop_flying() -> None:
    """Let this process end its chunk with the run it is in."""
    _stop.set()


def load_experiment(path: str) -> Experiment:
    """The experiment of an import path ``module:class``."""
    module, colon, name = path.partition(":")
    if not colon:
        raise StudyError(f"experiment: expected module:class, found {path}")
    try:
        made = getattr(importlib.import_module(module), name)()
    except ModuleNotFoundError as error:
        raise StudyError(f"experiment {path}: there is no module {error.name}") from error
    except AttributeError as error:
        raise StudyError(f"experiment {path}: {error}") from error
    experiment: Experiment = made
    return experiment


class SerialExecutor:
    """Flies in this process: nothing to start, and a debugger can look on."""

    def slots(self) -> int:
        """One."""
        return 1

    def submit(self, study: Study, runs: Sequence[int]) -> "Future[Chunk]":
        """Fly a chunk before this returns."""
        future: Future[Chunk] = Future()
        try:
            future.set_result(fly_chunk(study, runs, seconds=1.0))
        except Exception as error:
            future.set_exception(error)
        return future

    def stop(self) -> None:
        """End the chunk in the air with the run it is in."""
        stop_flying()

    def close(self) -> None:
        """Forget that flying was stopped."""
        _stop.clear()


class ProcessExecutor:
    """Processes of this machine, each in a pool of its own.

    So a worker's death takes down one chunk, which names its suspects, and one pool
    to rebuild. Workers hang on a lifeline: when this process dies, even by kill -9,
    they end too.
    """

    def __init__(self, workers: int):
        self._context = multiprocessing.get_context("spawn")
        self._slots = [_Slot(self._context) for _ in range(workers)]

    def slots(self) -> int:
        """The number of workers."""
        return len(self._slots)

    def submit(self, study: Study, runs: Sequence[int]) -> "Future[Chunk]":
        """Fly a chunk in an idle worker, started anew if the last one died."""
        idle = next(slot for slot in self._slots if slot.idle())
        return idle.submit(study, runs)

    def stop(self) -> None:
        """Tell all workers to end with the run they are in."""
        for slot in self._slots:
            slot.stop()

    def close(self) -> None:
        """End all workers now."""
        for slot in self._slots:
            slot.close()


class _Slot:
    """One worker process and its lifeline."""

    def __init__(self, context: Any):
        self._context = context
        self._pool: ProcessPoolExecutor | None = None
        self._lifeline: Connection | None = None
        self._future: Future[Chunk] | None = None

    def idle(self) -> bool:
        return self._future is None or self._future.done()

    def submit(self, study: Study, runs: Sequence[int]) -> "Future[Chunk]":
        if self._future is not None and isinstance(self._future.exception(), BrokenProcessPool):
            self.close()
        try:
            self._future = self._submit(study, runs)
        except BrokenProcessPool:  # it died while it was idle
            self.close()
            self._future = self._submit(study, runs)
        return self._future

    def _submit(self, study: Study, runs: Sequence[int]) -> "Future[Chunk]":
        if self._pool is None:
            end, self._lifeline = self._context.Pipe(duplex=False)
            self._pool = ProcessPoolExecutor(
                1, mp_context=self._context, initializer=_begin_worker, initargs=(end,)
            )
        with _interrupts_blocked():  # for the process this may spawn
            return self._pool.submit(fly_chunk, study, runs)

    def stop(self) -> None:
        if self._lifeline is not None and not self.idle():
            try:
                self._lifeline.send_bytes(b"stop")
            except OSError:
                return  # it is gone already

    def close(self) -> None:
        if self._lifeline is not None:
            self._lifeline.close()
            self._lifeline = None
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)
            self._pool = None
        self._future = None


class DaskExecutor:
    """Workers of a `dask.distributed` cluster, which share no disk with this machine.

    Parameters
    ----------
    scheduler : str
        The scheduler's address, as in ``tcp://host:8786``.
    timeout : float
        How long to wait for it, s.
    """

    def __init__(self, scheduler: str, timeout: float = 10.0):
        try:
            import distributed
        except ImportError:
            raise StudyError(
                "a scheduler needs dask.distributed, which is not installed: "
                "pip install 'plumbline[cluster]'"
            ) from None
        self._address = scheduler
        self._killed: type[Exception] = distributed.KilledWorker
        try:
            self._client = distributed.Client(scheduler, timeout=timeout, set_as_default=False)
        except (OSError, TimeoutError, ValueError) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise StudyError(f"no scheduler answers at {scheduler}: {reason}") from error
        self._futures = self._client.get_executor(pure=False, retries=0)

    def slots(self) -> int:
        """The number of workers there are now."""
        if self._client.status != "running":
            raise self._gone()
        return len(self._client.ncores())

    def submit(self, study: Study, runs: Sequence[int]) -> "Future[Chunk]":
        """Fly a chunk on any worker; the cluster flies it again if the worker dies."""
        answer: Future[Chunk] = Future()

        def translate(future: "Future[Chunk]") -> None:
            if future.cancelled():
                answer.set_exception(self._gone())
            elif (error := future.exception()) is None:
                answer.set_result(future.result())
            elif isinstance(error, self._killed):
                answer.set_exception(WorkerLostError(str(error)))
            elif isinstance(error, ImportError):
                answer.set_exception(
                    StudyError(f"the workers of {self._address} lack a module: {error}")
                )
            else:
                answer.set_exception(error)

        self._futures.submit(fly_chunk, study, runs).add_done_callback(translate)
        return answer

    def stop(self) -> None:
        """Chunks end by themselves within `CHUNK_SECONDS`."""

    def close(self) -> None:
        """Take back what is in the air and leave the cluster."""
        self._futures.shutdown(wait=False)
        self._client.close(timeout=2)

    def _gone(self) -> StudyError:
        return StudyError(
            f"the scheduler at {self._address} has gone; every run entered so far is kept: "
            "resume when it is back"
        )


_one_at_a_time = threading.Lock()  # an experiment is one diagram: a worker's threads take turns
_stop = threading.Event()
_prepared: tuple[tuple[str, str], Experiment] | None = None


def _experiment(study: Study) -> Experiment:
    """The process's experiment, built when the study is another than the last one."""
    global _prepared
    key = (study.experiment, study.digest)
    if _prepared is None or _prepared[0] != key:
        experiment = load_experiment(study.experiment)
        try:
            experiment.prepare(study)
        except StudyError:
            raise
        except Exception as error:
            raise StudyError(
                f"study {study.name}: its experiment cannot be prepared: {_one_line(error)}"
            ) from error
        _prepared = (key, experiment)
    return _prepared[1]


def _fly(experiment: Experiment, study: Study, spec: RunSpec) -> Row:
    cpu, wall = time.process_time(), time.monotonic()
    result: Row = {}
    failure = ""
    try:
        columns = experiment.run(spec.overrides, spec.seed)
        result = {name: _plain(name, value) for name, value in columns.items()}
    except StudyError:
        raise
    except Exception as error:
        failure = _one_line(error)
    else:
        _require_columns(study, spec, result)
    timing: Row = {
        "cpu_seconds": time.process_time() - cpu,
        "wall_seconds": time.monotonic() - wall,
        "worker": f"{platform.node()}:{os.getpid()}",
    }
    return _row(spec, failure) | timing | result


def _row(spec: RunSpec, failure: str) -> Row:
    return {
        "run": spec.run,
        "pair": spec.pair,
        "condition": spec.condition.label,
        "variant": spec.condition.variant,
        **{path: _plain_setting(value) for path, value in spec.varied.items()},
        "seed": spec.seed,
        "status": "failed" if failure else "done",
        "failure": failure,
    }


def _lost_row(study: Study, run: int) -> Row:
    failure = f"the worker process died in each of {MAX_DEATHS} attempts"
    return _row(study.run_spec(run), failure)


def _require_columns(study: Study, spec: RunSpec, result: Row) -> None:
    if missing := [name for name in study.measures.columns() if name not in result]:
        raise StudyError(
            f"study {study.name}: measures: the experiment gives no column {missing[0]}, "
            f"only {', '.join(result)}"
        )
    if taken := sorted(set(result) & set(_row(spec, ""))):
        raise StudyError(f"the experiment gives a column {taken[0]}, which the ledger fills")


def _require_provenance(chunk: Chunk) -> None:
    here = provenance()
    if chunk.provenance != here:
        differing = [key for key in here if chunk.provenance.get(key) != here[key]]
        raise StudyError(
            f"a worker flies other code than this machine ({', '.join(differing)} differs): "
            "install the same versions and the same source on both"
        )


def _plain(name: str, value: Any) -> bool | int | float | str:
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, (bool, int, float, str)):
        return value
    raise StudyError(
        f"the experiment's column {name} is a {type(value).__name__}: "
        "expected a number, a text or a truth value"
    )


def _plain_setting(value: Any) -> bool | int | float | str:
    """A varied value as a table holds it; lists and maps as JSON."""
    return value if isinstance(value, (bool, int, float, str)) else json.dumps(value)


def _one_line(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"[:500]


def _begin_worker(lifeline: Connection) -> None:
    """In a new worker: leave Ctrl-C to the parent, and end when the lifeline does."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    threading.Thread(target=_hold, args=(lifeline,), daemon=True).start()


def _hold(lifeline: Connection) -> None:
    try:
        while lifeline.recv_bytes() == b"stop":
            stop_flying()
    except (EOFError, OSError):
        os._exit(1)  # the parent has let go, or died


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
