"""One landing without GPS: simulate it and say what came of it, in plain numbers."""

import dataclasses
from typing import Any

import numpy as np
from pydrake.systems.analysis import Simulator

from diagrams.landing_without_gps import LandingWithoutGpsDiagram, LandingWithoutGpsScenario
from systems.configuration import StructureChangedError
from systems.estimators.runway_record import END, PASSAGE

_ERRORS = PASSAGE.fields[1:]
_built: dict[str, LandingWithoutGpsDiagram] = {}


def diagram_for(scenario: LandingWithoutGpsScenario) -> LandingWithoutGpsDiagram:
    """The process's one diagram, configured for `scenario`; built anew only if it must be."""
    if "diagram" in _built:
        try:
            _built["diagram"].configure(scenario)
        except StructureChangedError:
            del _built["diagram"]
    if "diagram" not in _built:
        _built["diagram"] = LandingWithoutGpsDiagram(scenario)
    return _built["diagram"]


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
        `landed` (stopped on the runway), `stop_time` and the other numbers of
        `LandingEnd`, and for each distance d of the record `lateral_300` and so
        on: the entries of `PASSAGE` at it.
    """
    scenario = dataclasses.replace(scenario, seed=seed)
    landing = diagram_for(scenario)
    simulator = Simulator(landing.diagram)
    simulator.Initialize()
    simulator.AdvanceTo(scenario.duration)
    context = simulator.get_context()
    end = END(landing.diagram.GetOutputPort("end").Eval(context))
    passages = landing.diagram.GetOutputPort("passages").Eval(context)
    results: dict[str, Any] = {
        name: float(value) for name, value in zip(END.fields, end[:], strict=True)
    }
    runway = scenario.runway
    half = 0.5 * runway.width
    results["landed"] = bool(
        end.stop_time >= 0.0
        and end.farthest_x <= half
        and end.touchdown_y >= -300.0
        and end.stop_y <= runway.length
    )
    rows = np.reshape(passages, (-1, PASSAGE.size))
    for distance, row in zip(scenario.record.distances, rows, strict=True):
        for name in _ERRORS:
            results[f"{name}_{distance:g}"] = float(row[PASSAGE.index(name)])
    return results
