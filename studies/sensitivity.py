"""Which disturbances matter to a landing: the analysis behind `plumbline sensitivity`.

The parameters are those of a `Space`, each over its whole range, and one more, chance: which seed
the noise has. What does no more to a landing than chance does not matter. Methods,
from the library SALib:

* Morris: elementary effects on trajectories that change one parameter at a time; μ* is the mean
  of their absolute values over the range, σ their spread, which tells interactions (Morris,
  Technometrics 33(2), 1991; μ*: Campolongo, Cariboni, Saltelli, Environmental
  Modelling & Software 22(10), 2007);
* Sobol: the share of the output's variance that a parameter makes alone (S1) and in all
  its interactions (ST) (Sobol', Mathematics and Computers in Simulation 55, 2001; Saltelli et al.,
  Computer Physics Communications 181(2), 2010).
"""

import io
import json
import math
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import NDArray
from SALib.analyze import morris as morris_analysis
from SALib.analyze import sobol as sobol_analysis
from SALib.sample import morris as morris_sample
from SALib.sample import sobol as sobol_sample

from diagrams.loading import ScenarioError, load_scenario
from studies import figures
from studies.campaign import default_workers, stop_on_signal
from studies.disturbances import Space, Window
from studies.executors import make_executor
from studies.flight_book import EXPERIMENT, FlightBook, InterruptedSearchError
from studies.ledger import Row, write_durably
from studies.page import Section, write_page
from studies.study import StudyError

CHANCE = "chance"
FAR = 3.0  # m; a landing farther off, or none at all, counts as this far
CONFIDENCE = 0.95
LEVELS = 4  # of a parameter in Morris's trajectories
_CHANCES = 1000  # seeds
_FEWEST = {"morris": 4, "sobol": 8}  # trajectories; base samples
Method = Literal["morris", "sobol"]

# Column, title, unit, of what is analysed.
OUTPUTS = (("error", "landing error", "m"), ("time", "landing time", "s"))
# By method: the number that ranks, its interval, what it is called, and the columns of the table.
INDICES = {
    "morris": ("mu_star", "mu_star_conf", "μ*", ["mu_star", "mu_star_conf", "mu", "sigma"]),
    "sobol": ("ST", "ST_conf", "ST", ["ST", "ST_conf", "S1", "S1_conf"]),
}


@dataclass
class Sensitivity:
    """An analysis; `table` has a row for each output and parameter."""

    folder: Path
    scenario: str
    base: dict[str, Any]  # overrides of every flight
    space: Space
    method: Method
    seed: int
    flights: pd.DataFrame  # a row a flight: parameters in [0, 1], their values, outputs
    table: pd.DataFrame

    def ranked(self, output: str) -> pd.DataFrame:
        """The parameters by their index, the largest first."""
        rows = self.table[self.table["output"].eq(output)]
        return rows.sort_values(INDICES[self.method][0], ascending=False, kind="stable")

    def sentences(self) -> list[str]:
        """What matters, in words."""
        index, _, symbol, _ = INDICES[self.method]
        sentences = []
        for output, title, unit in OUTPUTS:
            ranked = self.ranked(output)
            unit = f" {unit}" if self.method == "morris" else ""
            parts = [
                f"{row.parameter} ({symbol} {getattr(row, index):.2g}{unit})"
                for row in ranked.head(3).itertuples()
            ]
            sentences.append(f"{title[:1].upper()}{title[1:]}: most by {', '.join(parts)}")
        return sentences


def analyse(
    scenario: str,
    folder: Path | str,
    vary: Sequence[str],
    runs: int = 300,
    method: Method = "morris",
    *,
    overrides: Mapping[str, Any] | None = None,
    limits: Mapping[str, float] | None = None,
    seed: int = 1,
    workers: int | None = None,
    progress: bool = True,
    experiment: str = EXPERIMENT,
) -> Sensitivity | None:
    """Analyse which disturbances matter, and report it.

    Parameters
    ----------
    scenario : str
        A name or the path of a YAML file.
    folder : Path or str
        Where `sensitivity.csv`, `sensitivity.json`, `runs.csv`, `report.md`, `report.html` and
        `flights.jsonl` go.
    vary : sequence of str
        Names of `studies.disturbances.DISTURBANCES`.
    runs : int
        Flights at most; the methods ask for a multiple of their own.
    method : {"morris", "sobol"}
        The former screens with few flights, the latter shares out the variance.
    overrides, limits, seed, workers, progress, experiment
        As in `studies.falsification.falsify`.

    Returns
    -------
    Sensitivity or None
        None if interrupted; asked for again, it goes on.

    Raises
    ------
    StudyError
        In one sentence for the user.
    """
    base = dict(overrides or {})
    try:
        space = Space(load_scenario(scenario, base), vary, limits)
    except ScenarioError as error:
        raise StudyError(str(error)) from None
    problem = _problem(space)
    points = _sample(problem, runs, method, seed)
    folder = Path(folder)
    count = default_workers() if workers is None else workers
    with (
        closing(make_executor(count)) as executor,
        stop_on_signal() as stopping,
        FlightBook(
            folder, scenario, base, executor, len(points), stopping, progress, experiment
        ) as book,
    ):
        try:
            if space.needs_window:
                space.window = _window(book, seed)
            cases = [(space.overrides(point[:-1]), _seed(seed, point[-1])) for point in points]
            rows = book.fly(cases)
        except InterruptedSearchError:
            return None
    flights = _flights(space, points, rows)
    table = _analyse(problem, points, flights, method, seed)
    made = Sensitivity(folder, scenario, base, space, method, seed, flights, table)
    _write(made)
    return made


def _problem(space: Space) -> dict[str, Any]:
    names = [*(variable.name for variable in space.variables), CHANCE]
    return {"num_vars": len(names), "names": names, "bounds": [[0.0, 1.0]] * len(names)}


def _sample(problem: dict[str, Any], runs: int, method: Method, seed: int) -> NDArray[np.float64]:
    """The points of the unit cube that the method asks for, at most `runs`."""
    parameters = problem["num_vars"]
    step = parameters + (1 if method == "morris" else 2)
    times = runs // step
    if times < _FEWEST[method]:
        raise StudyError(
            f"--runs {runs}: {method} with {parameters} parameters needs "
            f"{_FEWEST[method] * step} or more"
        )
    if method == "morris":
        points = morris_sample.sample(problem, times, num_levels=LEVELS, seed=seed)
    else:
        base = 1 << (times.bit_length() - 1)  # Sobol' sequences are balanced at powers of two
        points = sobol_sample.sample(problem, base, calc_second_order=False, seed=seed)
    return np.asarray(points, float)


def _seed(seed: int, chance: float) -> int:
    return _CHANCES * seed + min(int(chance * _CHANCES), _CHANCES - 1)


def _window(book: FlightBook, seed: int) -> Window:
    (row,) = book.fly([({}, _seed(seed, 0.0))])
    if not row.get("landed"):
        raise StudyError("the undisturbed landing, from which times are counted, does not land")
    start = float(row["landing_started_s"])
    return Window(start, start + float(row["landing_time_s"]))


def _flights(space: Space, points: NDArray[np.float64], rows: list[Row]) -> pd.DataFrame:
    columns: dict[str, list[Any]] = {}
    for index, variable in enumerate(space.variables):
        columns[variable.name] = [variable.value(float(point[index])) for point in points]
    failed = [row["failure"] for row in rows if row["status"] != "done"]
    if failed:
        raise StudyError(f"{len(failed)} of {len(rows)} flights failed: {failed[0]}")
    landed = np.array([bool(row["landed"]) for row in rows])
    error = np.array([float(row["landing_error_m"]) for row in rows])
    time = np.array([float(row["landing_time_s"]) for row in rows])
    # Without a touchdown: from the routine's start, or else from take-off, to the end of the run.
    flown = [float(row["simulated_s"]) - max(float(row["landing_started_s"]), 0.0) for row in rows]
    return pd.DataFrame(columns).assign(
        landed=landed,
        reason=[str(row["reason"]) for row in rows],
        error=np.where(landed & (error < FAR), error, FAR),
        time=np.where(np.isfinite(time), time, flown),
    )


def _analyse(
    problem: dict[str, Any],
    points: NDArray[np.float64],
    flights: pd.DataFrame,
    method: Method,
    seed: int,
) -> pd.DataFrame:
    rows = []
    for output, _, _ in OUTPUTS:
        values = flights[output].to_numpy(float)
        names = INDICES[method][3]
        if np.ptp(values) == 0.0:  # nothing varies, and SALib would divide by it
            found: Mapping[str, Any] = {name: np.zeros(problem["num_vars"]) for name in names}
        elif method == "morris":
            found = morris_analysis.analyze(
                problem, points, values, conf_level=CONFIDENCE, num_levels=LEVELS, seed=seed
            )
        else:
            found = sobol_analysis.analyze(
                problem, values, calc_second_order=False, conf_level=CONFIDENCE, seed=seed
            )
        for index, parameter in enumerate(problem["names"]):
            numbers = {name: float(found[name][index]) for name in names}
            rows.append({"output": output, "parameter": parameter, **numbers})
    return pd.DataFrame(rows)


def _write(made: Sensitivity) -> None:
    for name, table in (("sensitivity", made.table), ("runs", made.flights)):
        sink = io.StringIO()
        table.to_csv(sink, index=False, float_format="%.6g")
        write_durably(made.folder / f"{name}.csv", sink.getvalue().encode())
    sentence = ". ".join(made.sentences()) + "."
    said = {
        "scenario": made.scenario,
        "method": made.method,
        "flights": len(made.flights),
        "sentence": sentence,
    }
    text = json.dumps(said, indent=2, ensure_ascii=False)
    write_durably(made.folder / "sensitivity.json", f"{text}\n".encode())
    with figures.style():
        write_page(made.folder, f"What matters to {made.scenario}?", sentence, _sections(made))


def _sections(made: Sensitivity) -> list[Section]:
    _, _, symbol, columns = INDICES[made.method]
    not_landed = int((~made.flights["landed"]).sum())
    meaning = (
        "μ*: by how much a parameter changes the output over its range, in the mean; σ: how "
        "differently, from interactions and curvature."
        if made.method == "morris"
        else "ST: the share of the output's variance that goes with a parameter, alone (S1) or "
        "with others."
    )
    sections = [
        Section(
            "What matters",
            f"{meaning} Bars: {symbol} with its {CONFIDENCE:.0%} interval. Grey: chance, the seed "
            "of all noise; what does no more than chance does not matter.",
            figure=bars(made),
            name="sensitivity",
        )
    ]
    for output, title, unit in OUTPUTS:
        rows = [
            [str(row["parameter"]), *(f"{row[name]:.3g}" for name in columns)]
            for _, row in made.ranked(output).iterrows()
        ]
        unit = f" ({unit})" if made.method == "morris" else ""
        sections.append(
            Section(f"{title[:1].upper()}{title[1:]}{unit}", head=["", *columns], rows=rows)
        )
    ranges = [
        [v.name, f"{v.low:.4g} to {v.high:.4g} {v.unit}".strip()] for v in made.space.variables
    ]
    sections.append(
        Section(
            "What was flown",
            f"{len(made.flights)} flights, {made.method} with seed {made.seed}; {not_landed} did "
            f"not land, which counts as a landing {FAR:g} m off, as does one farther off.",
            head=["", "range"],
            rows=ranges,
        )
    )
    return sections


def bars(made: Sensitivity) -> Figure:
    """The bar chart: a panel an output, the parameters ranked."""
    index, interval, symbol, _ = INDICES[made.method]
    names = made.table["parameter"].nunique()
    drawn = figures.figure(9.4, 1.0 + 0.3 * names)
    for axes, (output, title, unit) in zip(drawn.subplots(1, 2), OUTPUTS, strict=True):
        ranked = made.ranked(output)
        at = -np.arange(len(ranked))
        hues = [
            figures.PALETTE[0] if name == CHANCE else figures.PALETTE[2]
            for name in ranked["parameter"]
        ]
        axes.barh(at, ranked[index], 0.6, color=hues, alpha=0.75)
        axes.errorbar(
            ranked[index], at, xerr=ranked[interval].fillna(0.0), fmt="none",
            ecolor=figures.INK, elinewidth=1.1, capsize=2.5,
        )  # fmt: skip
        axes.set_yticks(at, ranked["parameter"])
        axes.tick_params(axis="y", colors=figures.INK)
        axes.grid(axis="y", visible=False)
        axes.set_xlim(left=min(0.0, math.floor(10.0 * ranked[index].min()) / 10.0))
        axes.set_title(title)
        axes.set_xlabel(f"{symbol} ({unit})" if made.method == "morris" else symbol)
    return drawn
