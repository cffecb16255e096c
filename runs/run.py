"""One run: a scenario flown from take-off to touchdown, judged from the true states."""

import itertools
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib import metadata
from pkgutil import resolve_name
from typing import Any, ClassVar

import numpy as np
import pyarrow as pa
from pydrake.systems.analysis import InitializeParams, Simulator, SimulatorStatus
from pydrake.systems.framework import Context, Diagram, System

from diagrams.landing import LandingDiagram
from diagrams.loading import ScenarioError, to_plain
from diagrams.scenario import MultirotorLanding
from runs.logs import log_table
from systems.configuration import StructureChangedError
from systems.signals.measurement import SUPERVISOR_STATUS, TOUCHDOWN

CHUNK = 0.64  # s of simulated time between two looks at the progress, on the grid of all events

Progress = Callable[[Context], None]


@dataclass
class RunResult:
    """What came of a run; `summary` is the content of `run.json`."""

    scenario: MultirotorLanding
    landed: bool
    reason: str
    landing_error_m: float  # of the reference point from where it should have landed
    landing_offset_m: list[float]  # [x, y] east and north
    landing_time_s: float  # from the start of the landing routine to first contact
    touchdown_speed_m_s: float  # downwards, just before first contact
    attempts: int
    simulated_s: float
    cpu_s: float  # the simulation loop alone
    versions: dict[str, str] = field(default_factory=dict)

    def summary(self) -> dict[str, Any]:
        """The result as plain data, for `run.json`."""
        return {
            "scenario": self.scenario.name,
            "seed": self.scenario.seed,
            "landed": self.landed,
            "reason": self.reason,
            "landing_error_m": self.landing_error_m,
            "landing_offset_m": self.landing_offset_m,
            "landing_time_s": self.landing_time_s,
            "touchdown_speed_m_s": self.touchdown_speed_m_s,
            "attempts": self.attempts,
            "simulated_s": self.simulated_s,
            "cpu_s": self.cpu_s,
            "versions": self.versions,
            "configuration": to_plain(self.scenario),
        }

    def sentences(self) -> list[str]:
        """The result in words, for the command line."""
        verdict = f"{'Landed' if self.landed else 'Not landed'}: {self.reason}"
        if not self.landed:
            return [verdict, f"After {self.simulated_s:.1f} s and {self.attempts} attempts"]
        return [
            verdict,
            f"Landing error {100 * self.landing_error_m:.1f} cm, "
            f"landing time {self.landing_time_s:.1f} s, "
            f"touchdown at {self.touchdown_speed_m_s:.2f} m/s",
        ]

    def figures(self) -> list[tuple[str, str]]:
        """The numbers at the head of the report: value and name."""
        x, y = (100.0 * value for value in self.landing_offset_m)
        speed = self.simulated_s / self.cpu_s if self.cpu_s > 0.0 else float("nan")
        return [
            (f"{100.0 * self.landing_error_m:.1f} cm", "landing error"),
            (f"{x:+.0f}, {y:+.0f} cm", "east, north"),
            (f"{self.touchdown_speed_m_s:.2f} m/s", "touchdown speed"),
            (f"{self.landing_time_s:.1f} s", "landing time"),
            (f"{self.attempts}", "attempt" if self.attempts == 1 else "attempts"),
            (f"{self.simulated_s:.0f} s", "flight"),
            (f"{speed:.0f} ×", "simulated seconds per CPU second"),
        ]


class Laboratory:
    """One diagram, flown as often as wanted.

    Drake's Python systems are never freed, so a process builds a diagram once and
    runs it again and again; `configure` changes whatever does not shape the diagram.

    Parameters
    ----------
    scenario : MultirotorLanding
        What to build and, until `configure` says otherwise, to fly.

    Attributes
    ----------
    builds : type
        The class of its diagram; a laboratory of another kind of scenario names another.

    Raises
    ------
    ScenarioError
        If the scenario's parts do not fit together.
    """

    builds: ClassVar[type] = LandingDiagram

    def __init__(self, scenario: Any):
        with _scenario_errors(scenario):
            self.landing = self.builds(scenario)
        self.diagram = self.landing.diagram
        self.scenario = scenario

    def configure(self, scenario: Any) -> None:
        """Take over another scenario of the same structure; raises `StructureChangedError`."""
        with _scenario_errors(scenario):
            self.landing.configure(scenario)
        self.scenario = scenario

    def start(self) -> Simulator:
        """A simulator at time zero."""
        simulator = self._simulator(self.diagram.CreateDefaultContext())
        simulator.Initialize()
        return simulator

    def resume(self, context: Context) -> Simulator:
        """A simulator that goes on from `context` (a clone, say) as if never stopped."""
        simulator = self._simulator(context)
        simulator.Initialize(InitializeParams(suppress_initialization_events=True))
        return simulator

    def _simulator(self, context: Context) -> Simulator:
        simulator = Simulator(self.diagram, context)
        # While something holds them, Python's wrappers of the contexts are not made anew at every
        # event: a twentieth of the running time.
        self._contexts = list(_contexts(self.diagram, context))
        return simulator

    def fly(self, simulator: Simulator | None = None, progress: Progress | None = None) -> Any:
        """Fly to the end of the run; returns its result.

        Parameters
        ----------
        simulator : Simulator, optional
            From `start` or `resume`; a fresh one if not given.
        progress : callable, optional
            Called with the root context every `CHUNK` of simulated time.
        """
        simulator = simulator or self.start()
        context = simulator.get_context()
        cpu = 0.0
        start = context.get_time()
        for chunk in itertools.count(1):
            begin = time.process_time()
            status = simulator.AdvanceTo(start + chunk * CHUNK)
            cpu += time.process_time() - begin
            if progress:
                progress(context)
            if status.reason() == SimulatorStatus.ReturnReason.kReachedTerminationCondition:
                break  # by the observer, at its time limit at the latest
        return self.result(context, cpu)

    def result(self, context: Context, cpu: float = 0.0) -> Any:
        """The verdict on the run so far."""
        touchdown = TOUCHDOWN(self.landing.evaluate("touchdown", context))
        status = SUPERVISOR_STATUS(self.landing.evaluate("supervisor", context))
        offset = np.array([touchdown.offset_x, touchdown.offset_y])
        if self.scenario.measure_from == "start":
            offset += np.subtract(self.scenario.pad.position, self.scenario.vehicle.position)[:2]
        begun = status.landing_started >= 0.0 and touchdown.time >= 0.0
        return RunResult(
            scenario=self.scenario,
            landed=bool(touchdown.landed),
            reason=self.landing.reason(context),
            landing_error_m=float(np.hypot(*offset)),
            landing_offset_m=offset.tolist(),
            landing_time_s=float(touchdown.time - status.landing_started)
            if begun
            else float("nan"),
            touchdown_speed_m_s=float(touchdown.vertical_speed),
            attempts=int(status.attempts),
            simulated_s=float(context.get_time()),
            cpu_s=cpu,
            versions=versions(),
        )

    def log(self, context: Context) -> pa.Table:
        """Everything recorded in `context`, as the table of `log.parquet`."""
        recording = self.landing.recording
        return log_table(recording, recording.samples(context))


@contextmanager
def _scenario_errors(scenario: Any) -> Iterator[None]:
    """What a block refuses is an error of the scenario."""
    try:
        yield
    except StructureChangedError:
        raise
    except ValueError as error:
        raise ScenarioError(f"scenario {scenario.name}: {error}") from error


def _contexts(system: System, root: Context) -> Iterator[Context]:
    """The contexts of everything in a system, but not its own.

    Asked for the root's own context, Drake's bindings make it keep itself alive for ever.
    """
    if isinstance(system, Diagram):
        for part in system.GetSystems():
            yield part.GetMyContextFromRoot(root)
            yield from _contexts(part, root)


# Who flies a kind of scenario, module:class; imported when first needed.
LABORATORIES = {
    "multirotor_landing": "runs.run:Laboratory",
    "landing_without_gps": "runs.landing_without_gps:RunwayLaboratory",
}
_laboratories: list[Laboratory] = []
_KEPT = 64  # diagrams a process keeps; each costs about a megabyte


def laboratory(scenario: Any) -> Laboratory:
    """A laboratory for `scenario`, re-used within the process where the structure allows."""
    for lab in _laboratories:
        if type(lab.scenario) is not type(scenario):
            continue
        try:
            lab.configure(scenario)
        except StructureChangedError:
            continue
        return lab
    new: Laboratory = resolve_name(LABORATORIES[scenario.kind])(scenario)
    _laboratories.append(new)
    del _laboratories[:-_KEPT]
    return new


def versions() -> dict[str, str]:
    """Versions of what a result depends on."""
    names = ("plumbline", "drake", "numpy", "numba", "opencv-python-headless")
    return {name: metadata.version(name) for name in names}
