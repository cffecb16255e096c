"""`python -m benchmarks.damaged_logs [COUNT]`: replays of damaged logs, 10 000 by default.

Every one must end in a result or in one sentence; anything else stops the run.
"""

import sys
import tempfile
import time
from pathlib import Path

from tests.runs.damage import csv_stream, damaged, outcome, ulog_stream


def main(count: int = 10_000) -> None:
    """Damage and replay `count` logs, CSV and ULog in turn."""
    started = time.perf_counter()
    streams = csv_stream(), ulog_stream()
    refused = 0
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(count):
            sentence = outcome(damaged(streams[seed % 2], seed), Path(folder) / "log")
            if "\n" in sentence:
                raise SystemExit(f"seed {seed}: more than one sentence: {sentence}")
            refused += sentence != ""
    seconds = time.perf_counter() - started
    print(f"{count} damaged logs in {seconds:.0f} s: {refused} refused, {count - refused} replayed")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
