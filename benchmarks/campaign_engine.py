"""What campaigns survive and what they keep: `python -m benchmarks.campaign_engine`.

A storm of `kill -9` on workers and parents, and the growth of a worker's memory.
"""

import argparse
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil
import pyarrow.parquet as pq

from studies.campaign import resume, run_study
from studies.landing_experiment import LandingExperiment
from studies.study import load_study
from tests.studies import driver

KILLS = 20  # of workers, and as many of parents
STORM_RUNS = 8000  # of 10 ms
IN_FLIGHT = 0.8  # of the blows fall after rows were written, the others while workers start
MEMORY_RUNS = 200
SETTLED = 26  # landings after which everything is compiled and every diagram built
MEGABYTE = 1e6


def _workers(parent: psutil.Process) -> list[psutil.Process]:
    """The worker processes of a campaign's parent."""
    return [
        child for child in parent.children() if "resource_tracker" not in " ".join(child.cmdline())
    ]


def _strike(folder: Path, chance: random.Random) -> int:
    """Start or continue a campaign, kill a worker and then the parent; returns the rows so far."""
    command = [sys.executable, driver.__file__, str(folder), "2", str(STORM_RUNS)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    parent = psutil.Process(process.pid)
    while len(workers := _workers(parent)) < 2 and process.poll() is None:
        time.sleep(0.01)
    if process.poll() is not None:
        raise RuntimeError("the campaign ended before the storm: fly it by hand and see why")
    if chance.random() < IN_FLIGHT:
        before = _rows(folder)
        while _rows(folder) == before and process.poll() is None:
            time.sleep(0.01)
    for victim in (chance.choice(workers), parent):
        time.sleep(chance.uniform(0.0, 1.0))
        if process.poll() is not None:
            raise RuntimeError("the campaign ended in the middle of the storm: give it more runs")
        orphans = _workers(parent)
        victim.kill()
    process.wait()
    # One that is still importing cannot notice yet.
    if psutil.wait_procs(orphans, timeout=60.0)[1]:
        raise RuntimeError("a worker outlived its parent")
    return _rows(folder)


def _rows(folder: Path) -> int:
    """The rows that a campaign has written."""
    return sum(pq.read_metadata(shard).num_rows for shard in folder.glob("shards/*.parquet"))


def kill_storm(kills: int = KILLS) -> None:
    """Print whether a campaign that was killed again and again has an undisturbed one's rows."""
    chance = random.Random(20)
    with tempfile.TemporaryDirectory() as scratch:
        disturbed, calm = Path(scratch) / "disturbed", Path(scratch) / "calm"
        progress = [_strike(disturbed, chance) for _ in range(kills)]
        result = resume(disturbed, workers=2, progress=False)
        run_study(driver.slow_study(), calm, STORM_RUNS, workers=2, progress=False)
        rows = pq.read_table(disturbed / "runs.parquet")["run"].to_pylist()
        same = (disturbed / "runs.parquet").read_bytes() == (calm / "runs.parquet").read_bytes()
    print(f"Kill storm: {kills} workers and {kills} parents killed at random moments")
    print(f"  rows in shards after each   {', '.join(map(str, progress))}")
    print(f"  after resuming              {result.done} of {result.runs} runs")
    print(
        f"  lost, double                {STORM_RUNS - len(set(rows))}, {len(rows) - len(set(rows))}"
    )
    print(f"  bytes of an undisturbed one {'identical' if same else 'DIFFERENT'}")


def worker_memory(runs: int = MEMORY_RUNS) -> None:
    """Print how a worker's memory grows over the landings of the thesis's study."""
    study = load_study("infrared-and-marker")
    experiment = LandingExperiment()
    experiment.prepare(study)
    process = psutil.Process()
    sizes = []
    for spec in study.run_specs(SETTLED + runs):
        experiment.run(spec.overrides, spec.seed)
        sizes.append(process.memory_info().rss)
    settled, last = sizes[SETTLED - 1], sizes[-1]
    rate = (last - settled) / runs * 1000.0
    print(f"A worker's memory over {runs} landings after the first {SETTLED}")
    print(f"  resident then {settled / MEGABYTE:.1f} MB, at the end {last / MEGABYTE:.1f} MB")
    print(f"  growth        {rate / MEGABYTE:+.1f} MB per 1000 landings")
    print(f"  most          {max(sizes[SETTLED - 1 :]) / MEGABYTE:.1f} MB")


def main() -> None:
    """Run both."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=KILLS)
    parser.add_argument("--runs", type=int, default=MEMORY_RUNS)
    arguments = parser.parse_args()
    if arguments.kills:
        kill_storm(arguments.kills)
    if arguments.runs:
        worker_memory(arguments.runs)


if __name__ == "__main__":
    main()
