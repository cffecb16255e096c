"""One landing without GPS: from the start to a standstill, judged from the true states."""

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pydrake.systems.framework import Context

from diagrams.landing_without_gps import LandingWithoutGpsDiagram, LandingWithoutGpsScenario
from diagrams.loading import to_plain
from runs.run import Laboratory, laboratory, versions
from systems.estimators.runway_record import END, PASSAGE

_ERRORS = PASSAGE.fields[1:]
_EARLIEST = -300.0  # m, wheels before this place are short of the runway (half its threshold)


@dataclass
class RunwayResult:
    """What came of a landing without GPS; `summary` is the content of `run.json`."""

    scenario: LandingWithoutGpsScenario
    landed: bool  # stopped, and never off the runway
    reason: str
    end: dict[str, float]  # the numbers of `LandingEnd`
    passages: dict[str, float]  # the entries of `PASSAGE` by distance, as in `lateral_300`
    rejected: int  # measurements refused by the filter's gate
    simulated_s: float
    cpu_s: float  # the simulation loop alone
    versions: dict[str, str] = field(default_factory=dict)

    def numbers(self) -> dict[str, Any]:
        """The result as one flat row."""
        return {"landed": self.landed, "reason": self.reason, **self.end, **self.passages}

    def summary(self) -> dict[str, Any]:
        """The result as plain data, for `run.json`."""
        return {
            "scenario": self.scenario.name,
            "seed": self.scenario.seed,
            **self.numbers(),
            "rejected": self.rejected,
            "simulated_s": self.simulated_s,
            "cpu_s": self.cpu_s,
            "versions": self.versions,
            "configuration": to_plain(self.scenario),
        }

    def sentences(self) -> list[str]:
        """The result in words, for the command line."""
        verdict = f"{'Landed' if self.landed else 'Not landed'}: {self.reason}"
        if self.end["touchdown_time"] < 0.0:
            return [verdict, f"After {self.simulated_s:.0f} s"]
        nearest = min(self.scenario.record.distances)
        return [
            verdict,
            f"Touchdown {self.end['touchdown_y']:+.0f} m along and "
            f"{self.end['touchdown_x']:+.1f} m right of the touch-down point at "
            f"{self.end['touchdown_sink']:.2f} m/s, stopped after {self.end['stop_y']:.0f} m",
            f"Estimate {nearest:g} m before it: {self.passages[f'longitudinal_{nearest:g}']:+.1f} m"
            f" along, {self.passages[f'lateral_{nearest:g}']:+.1f} m across",
        ]

    def figures(self) -> list[tuple[str, str]]:
        """The numbers at the head of the report: value and name."""
        nearest = min(self.scenario.record.distances)
        along, across = (
            self.passages[f"{axis}_{nearest:g}"] for axis in ("longitudinal", "lateral")
        )
        speed = self.simulated_s / self.cpu_s if self.cpu_s > 0.0 else math.nan
        return [
            (f"{along:+.1f} m", f"estimate along, at {nearest:g} m"),
            (f"{across:+.1f} m", f"estimate across, at {nearest:g} m"),
            (f"{self.end['touchdown_y']:+.0f} m", "touchdown along"),
            (f"{self.end['touchdown_x']:+.1f} m", "touchdown across"),
            (f"{self.end['touchdown_sink']:.2f} m/s", "sink rate"),
            (f"{self.end['stop_y']:.0f} m", "standstill"),
            (f"{self.simulated_s:.0f} s", "flight"),
            (f"{speed:.0f} ×", "simulated seconds per CPU second"),
        ]


class RunwayLaboratory(Laboratory):
    """One diagram of a landing without GPS, flown as often as wanted."""

    builds = LandingWithoutGpsDiagram

    def result(self, context: Context, cpu: float = 0.0) -> RunwayResult:
        """The verdict on the run so far."""
        scenario = self.scenario
        rows = np.reshape(self.landing.evaluate("passages", context), (-1, PASSAGE.size))
        numbers = landing_numbers(self.landing.evaluate("end", context), rows, scenario)
        landed, reason = numbers.pop("landed"), numbers.pop("reason")
        return RunwayResult(
            scenario=scenario,
            landed=landed,
            reason=reason,
            end={name: numbers.pop(name) for name in END.fields},
            passages=numbers,
            rejected=int(self.landing.evaluate("estimate", context)[37]),
            simulated_s=float(context.get_time()),
            cpu_s=cpu,
            versions=versions(),
        )


def landing_numbers(
    end: np.ndarray, passages: np.ndarray, scenario: LandingWithoutGpsScenario
) -> dict[str, Any]:
    """What came of a landing as one flat row, see `simulate_landing`.

    Parameters
    ----------
    end : array, shape (END.size,)
        Layout `LandingEnd`.
    passages : array, shape (distances, PASSAGE.size)
        One `PASSAGE` a distance of the scenario's record.
    scenario : LandingWithoutGpsScenario
    """
    reason = _reason(END(end), scenario)
    row: dict[str, Any] = {"landed": reason == "stopped on the runway", "reason": reason}
    row |= {name: float(value) for name, value in zip(END.fields, end, strict=True)}
    for distance, passage in zip(scenario.record.distances, passages, strict=True):
        for name in _ERRORS:
            row[f"{name}_{distance:g}"] = float(passage[PASSAGE.index(name)])
    return row


def _reason(end: Any, scenario: LandingWithoutGpsScenario) -> str:
    if end.touchdown_time < 0.0:
        return "time limit in the air"
    if end.touchdown_y < _EARLIEST:
        return "touched down before the runway"
    if end.farthest_x > 0.5 * scenario.runway.width:
        return "left the runway to the side"
    if end.stop_time < 0.0:
        return "time limit before the standstill"
    if end.stop_y > scenario.runway.length:
        return "overran the runway"
    return "stopped on the runway"


def simulate_landing(scenario: LandingWithoutGpsScenario, seed: int) -> dict[str, Any]:
    """Fly one landing.

    Parameters
    ----------
    scenario : LandingWithoutGpsScenario
        Its own seed is replaced.
    seed : int
        Of every noise and every error drawn once a run.

    Returns
    -------
    dict
        `landed`, `reason`, the numbers of `LandingEnd`, and for each distance of the
        record the entries of `PASSAGE` at it: `lateral_300` and so on.
    """
    result = laboratory(dataclasses.replace(scenario, seed=seed)).fly()
    numbers: dict[str, Any] = result.numbers()
    return numbers
