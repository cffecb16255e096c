"""The mildest disturbance that spoils a landing: the search behind `plumbline falsify`.

A case is a point of a `Space`; its severity |s| is the Euclidean norm of its strengths. It
spoils the landing if in most of a few fixed seeds the vehicle comes down farther than `miss` from
where it should, or does not land at all. The search minimises, in this order,

    f(case) = |s|                        if it spoils
    f(case) = sqrt(n) + 1 − m            if not, m = mean over seeds of min(error / miss, 1)

n being the number of disturbances: first it looks for any spoiled landing, led by the
errors, then for a milder one. Steps, all within one budget of flights:

1. undisturbed, which must land; each disturbance alone at its limit; all at their limits;
2. from the mildest of these that spoils, or the middle: CMA-ES (Hansen, "The CMA evolution
   strategy: a tutorial", arXiv 1604.00772; the library pycma), a generation at a time;
3. what the case does without is left out (Zeller and Hildebrandt, "Simplifying and
   isolating failure-inducing input", IEEE TSE 28(2), 2002), and its severity is
   bisected on the way back to the undisturbed landing;
4. seeds that the search has not seen confirm the case. A search picks what spoils its own few
   seeds, so where fewer than half of ten fresh ones agree, the strengths grow together, by a
   fifth each time, until half do, a limit is met or the budget is spent; the case on which most of
   them agree is kept.
"""

import io
import math
import os
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cma
import numpy as np
from numpy.typing import NDArray
from ruamel.yaml import YAML

from diagrams.loading import (
    ScenarioError,
    load_scenario,
    scenario_names,
    to_plain,
    to_yaml,
    with_overrides,
)
from studies.campaign import default_workers, stop_on_signal
from studies.disturbances import Space, Window
from studies.executors import make_executor
from studies.flight_book import EXPERIMENT, FlightBook, InterruptedSearchError
from studies.ledger import Row, write_durably
from studies.seeded_landing import SEED
from studies.study import StudyError

DEFAULT_DISTURBANCES = ("wind", "gust", "latency", "dropout", "drops")
MISS = 0.5  # m
SEEDS = 3  # flights that judge a case
FRESH_SEEDS = 10  # flights that check the case that was found
_BISECTIONS = 6  # of the case found, to 1/64 of its severity
_GROWTH = 1.2  # of the strengths, until fresh seeds agree
_GROWTHS = 5  # at most, with what is kept of the budget
_COARSE = 4  # of each disturbance alone, to 1/16 of its limit
_STEP = 0.25  # initial standard deviation of the search, of the unit cube
_MINIMUM_BUDGET = 40

Point = NDArray[np.float64]


@dataclass
class Case:
    """A point and what came of it."""

    point: Point
    severity: float
    rows: list[Row]  # of the seeds that were flown until it was decided
    spoils: bool
    badness: float  # mean over these seeds of min(error / miss, 1)
    asked: int  # flights asked for until then
    step: str  # of the search that tried it

    def worst(self) -> Row:
        """The flight that missed most."""
        flown = [row for row in self.rows if row["status"] == "done"] or self.rows
        return max(flown, key=lambda row: (not row.get("landed"), row.get("landing_error_m", 0.0)))


@dataclass
class Finding:
    """What a search has come to; everything the report says."""

    folder: Path
    scenario: str
    base: dict[str, Any]  # overrides of every flight
    space: Space
    seed: int
    seeds: list[int]  # that judge a case
    miss: float
    budget: int
    cases: list[Case] = field(default_factory=list)  # in the order they were tried
    undisturbed: Case | None = None
    # Each disturbance alone: the mildest that spoils, or else at its limit.
    alone: dict[str, Case] = field(default_factory=dict)
    together: Case | None = None  # all at their limits
    best: Case | None = None  # the mildest that spoils
    fresh: list[Row] = field(default_factory=list)  # of the best under other seeds
    luckiest: Case | None = None  # milder than the best, but fresh seeds do not agree
    asked: int = 0
    complete: bool = False  # not interrupted, and the budget sufficed for all steps
    interrupted: bool = False

    @property
    def confirmed(self) -> bool:
        """Whether half of the fresh seeds or more agree with the search."""
        return bool(self.fresh) and 2 * self.fresh_missed >= len(self.fresh)

    @property
    def fresh_missed(self) -> int:
        """In how many of the fresh seeds the case misses too."""
        return sum(missed(row, self.miss) for row in self.fresh)

    def sentence(self) -> str:
        """The finding in words."""
        names = ", ".join(entry.name for entry in self.space.disturbances)
        if self.undisturbed is not None and self.undisturbed.spoils:
            error = self.undisturbed.worst()
            return f"{self.scenario} misses undisturbed: {outcome(error)}"
        if self.best is None:
            return (
                f"{self.scenario}: no case that misses by more than {self.miss:g} m was found "
                f"in {self.asked} flights over {names}, each up to its limit"
            )
        text = (
            f"{self.scenario} is spoiled by {self.space.describe(self.best.point)}: "
            f"{outcome(self.best.worst())} (severity {self.best.severity:.2f})"
        )
        if self.luckiest is not None:
            text += f"; at severity {self.luckiest.severity:.2f} already under some seeds"
        if self.fresh:
            text += f"; it misses under {self.fresh_missed} of {len(self.fresh)} other seeds"
        return text


def fresh_seeds(finding: Finding) -> range:
    """Seeds that the search does not see."""
    first = max(finding.seeds) + 100
    return range(first, first + FRESH_SEEDS)


def missed(row: Row, miss: float) -> bool:
    """Whether a flight is spoiled: not landed, or farther than `miss` (m) from its place.

    One that failed says nothing about the landing (the report lists it), and a vehicle that
    refuses to take off has not spoiled one.
    """
    if row["status"] != "done" or not row["took_off"]:
        return False
    return not row["landed"] or float(row["landing_error_m"]) > miss


def outcome(row: Row) -> str:
    """What came of a flight, in words."""
    if row["status"] != "done":
        return f"failed: {row['failure']}"
    if not row["landed"]:
        return str(row["reason"])
    return f"landed {float(row['landing_error_m']):.2f} m off"


def falsify(
    scenario: str,
    folder: Path | str,
    vary: Sequence[str] = DEFAULT_DISTURBANCES,
    budget: int = 300,
    *,
    overrides: Mapping[str, Any] | None = None,
    limits: Mapping[str, float] | None = None,
    miss: float = MISS,
    seeds: int = SEEDS,
    seed: int = 1,
    workers: int | None = None,
    progress: bool = True,
    experiment: str = EXPERIMENT,
) -> Finding:
    """Search for the mildest disturbance that spoils the landing, and report it.

    Parameters
    ----------
    scenario : str
        A name or the path of a YAML file.
    folder : Path or str
        Where `case.yaml`, `report.md`, `report.html`, `finding.json` and `flights.jsonl` go. A
        search that was interrupted goes on when it is asked for again.
    vary : sequence of str
        Names of `studies.disturbances.DISTURBANCES`.
    budget : int
        Flights.
    overrides : mapping, optional
        Of the scenario, for every flight; dotted paths.
    limits : mapping, optional
        Other limits of disturbances, by name.
    miss : float
        m; farther from its place a landing is spoiled.
    seeds : int
        Flights that judge a case, which is spoiled if most of them are.
    seed : int
        Of the search; it names the seeds of the flights too.
    workers : int, optional
        Processes; 0 flies in this one (default: one a core). The finding does not depend on it.
    progress : bool
        Show a progress bar on the terminal.
    experiment : str
        The import path of what flies.

    Returns
    -------
    Finding

    Raises
    ------
    StudyError
        In one sentence for the user.
    """
    if budget < _MINIMUM_BUDGET:
        raise StudyError(f"--budget {budget}: expected {_MINIMUM_BUDGET} or more flights")
    if miss <= 0.0:
        raise StudyError(f"--miss {miss:g}: expected a distance above 0 m")
    base = dict(overrides or {})
    try:
        space = Space(load_scenario(scenario, base), vary, limits)
    except ScenarioError as error:
        raise StudyError(str(error)) from None
    judges = [1000 * seed + index for index in range(1, seeds + 1)]
    finding = Finding(Path(folder), scenario, base, space, seed, judges, miss, budget)
    count = default_workers() if workers is None else workers
    with (
        closing(make_executor(count)) as executor,
        stop_on_signal() as stopping,
        FlightBook(
            finding.folder, scenario, base, executor, budget, stopping, progress, experiment
        ) as book,
    ):
        try:
            _Search(finding, book).run()
            finding.complete = True
        except InterruptedSearchError:
            finding.interrupted = True
        finding.asked = book.asked
    # Imported when there is something to draw: matplotlib takes a second to load.
    from studies.falsification_report import write_report

    _write_case(finding)
    write_report(finding)
    return finding


def _write_case(finding: Finding) -> None:
    """Write the case found as a scenario that anyone can fly, or take away an old one."""
    path = finding.folder / "case.yaml"
    if finding.best is None:
        path.unlink(missing_ok=True)
        return
    best, worst = finding.best, finding.best.worst()
    case = {
        **finding.base,
        **finding.space.overrides(best.point),
        "name": f"{finding.space.scenario.name}-spoiled",
        "description": f"{finding.space.describe(best.point)}: {outcome(worst)}",
        SEED: next(s for s, row in zip(finding.seeds, best.rows, strict=False) if row is worst),
    }
    # On top of all the scenario's values, as it was flown.
    flown = with_overrides(load_scenario(finding.scenario), case)
    names = ", ".join(entry.name for entry in finding.space.disturbances)
    header = (
        f"# The mildest case found by: plumbline falsify {finding.scenario} --vary "
        f"{names.replace(' ', '')} --budget {finding.budget} --seed {finding.seed}\n"
        f"# Severity {best.severity:.3f}; {outcome(worst)}; under other seeds it misses by more "
        f"than {finding.miss:g} m in {finding.fresh_missed} of {len(finding.fresh)} flights.\n"
    )
    base = finding.scenario
    if base not in scenario_names():
        base = os.path.relpath(base, finding.folder)
    write_durably(path, (header + _yaml({"extends": base, **_nested(case)})).encode())
    # A map that a file gives in part loses the defaults of the field it stands in (a camera's
    # latency, say): such a map is written whole, and if that does not do, everything.
    read, wanted = to_plain(load_scenario(path)), to_plain(flown)
    for name in list(case):
        parent = name.rpartition(".")[0]
        if parent and _at(read, parent) != _at(wanted, parent):
            case.pop(name)
            case[parent] = _at(wanted, parent)
    write_durably(path, (header + _yaml({"extends": base, **_nested(case)})).encode())
    if to_plain(load_scenario(path)) != wanted:
        write_durably(path, (header + to_yaml(flown)).encode())


def _at(tree: Any, path: str) -> Any:
    for key in path.split("."):
        tree = tree.get(key) if isinstance(tree, dict) else None
    return tree


def _nested(overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Dotted paths as maps in maps."""
    tree: dict[str, Any] = {}
    for path, value in overrides.items():
        *parents, last = path.split(".")
        node = tree
        for key in parents:
            node = node.setdefault(key, {})
        node[last] = value
    return tree


def _yaml(tree: Mapping[str, Any]) -> str:
    stream = io.StringIO()
    yaml = YAML()
    yaml.default_flow_style = False
    yaml.width = 98
    yaml.dump(dict(tree), stream)
    return stream.getvalue()


class _Search:
    """The steps of the search; see the module's docstring."""

    def __init__(self, finding: Finding, book: FlightBook):
        self.finding, self.book, self.space = finding, book, finding.space
        self.count = len(self.space.disturbances)
        # What is kept for steps 3 and 4, if there is a case.
        judged = len(finding.seeds)
        self.reserve = (self.count - 1 + _BISECTIONS) * judged + 2 * FRESH_SEEDS

    def run(self) -> None:
        finding = self.finding
        self._begin()
        if finding.undisturbed is not None and finding.undisturbed.spoils:
            return
        if len(self.space.variables) > 1:
            self._evolve()
        if finding.best is not None:
            self._simplify()
            self._bisect(self._best(), _BISECTIONS)
            self._check()

    def _begin(self) -> None:
        """Step 1."""
        finding, space = self.finding, self.space
        calm = space.undisturbed()
        finding.undisturbed = self._judge([calm], "undisturbed")[0]
        if finding.undisturbed.spoils:
            return
        landed = [row for row in finding.undisturbed.rows if row.get("landed")]
        if not landed:
            raise StudyError(f"undisturbed: {outcome(finding.undisturbed.rows[0])}")
        if space.needs_window:
            row = landed[0]
            start = float(row["landing_started_s"])
            space.window = Window(start, start + float(row["landing_time_s"]))
        limits = []
        for index in space.strengths:
            point = calm.copy()
            point[index] = 1.0
            limits.append(point)
        everything = calm.copy()
        everything[space.strengths] = 1.0
        points = [*limits, everything] if self.count > 1 else limits
        judged = self._judge(points, "at the limit")
        names = [entry.name for entry in space.disturbances]
        finding.together = judged[-1]
        for name, case in zip(names, judged, strict=False):
            finding.alone[name] = self._bisect(case, _COARSE) if case.spoils else case
        if finding.best is finding.together:
            self._bisect(finding.together, _COARSE)

    def _evolve(self) -> None:
        """Step 2."""
        best = self.finding.best
        start = self.space.undisturbed()
        if best is None:
            start[self.space.strengths] = 0.5
        else:
            start = best.point.copy()
        periodic = [variable.periodic for variable in self.space.variables]
        strategy = cma.CMAEvolutionStrategy(
            # A strategy has two dimensions or more.
            start,
            _STEP,
            {
                "bounds": [
                    [None if free else 0.0 for free in periodic],
                    [None if free else 1.0 for free in periodic],
                ],
                # Noise from a generator of its own, and none of numpy's global state.
                "seed": math.nan,
                "randn": np.random.RandomState(self.finding.seed).randn,
                "verbose": -9,
            },
        )
        judged = len(self.finding.seeds)
        while not strategy.stop():
            kept = self.reserve if self.finding.best is not None else 0
            if self.book.left - kept < strategy.popsize * judged:
                return
            points = strategy.ask()
            cases = self._judge([np.asarray(point) for point in points], "search")
            strategy.tell(points, [self._cost(case) for case in cases])

    def _simplify(self) -> None:
        """Step 3: leave out one disturbance after the other, the strongest last."""
        best = self._best()
        order = sorted(self.space.strengths, key=lambda index: best.point[index])
        for index in order:
            point = self._best().point.copy()
            if point[index] > 0.0 and np.count_nonzero(point[self.space.strengths]) > 1:
                point[index] = 0.0
                self._judge([point], "left out")

    def _bisect(self, found: Case, times: int) -> Case:
        """Towards the undisturbed landing, circumstances as they are; returns the mildest."""
        low, high, mildest = 0.0, 1.0, found
        for _ in range(times):
            middle = 0.5 * (low + high)
            point = found.point.copy()
            point[self.space.strengths] *= middle
            (case,) = self._judge([point], "bisection")
            if case.spoils:
                high, mildest = middle, case
            else:
                low = middle
        return mildest

    def _check(self) -> None:
        """Step 4."""
        finding, found = self.finding, self._best()
        finding.fresh = self._fresh(found)
        strengths, largest = self.space.strengths, float(found.point[self.space.strengths].max())
        for power in range(1, _GROWTHS + 1):
            if finding.confirmed or self.book.left < FRESH_SEEDS + len(finding.seeds):
                break
            factor = min(_GROWTH**power, 1.0 / largest)
            point = found.point.copy()
            point[strengths] *= factor
            (case,) = self._judge([point], "confirmation")
            fresh = self._fresh(case)
            agreeing = sum(missed(row, finding.miss) for row in fresh)
            if case.spoils and agreeing > finding.fresh_missed:
                finding.luckiest, finding.best, finding.fresh = found, case, fresh
            if factor * largest >= 1.0:
                break

    def _fresh(self, case: Case) -> list[Row]:
        overrides = self.space.overrides(case.point)
        return self.book.fly([(overrides, seed) for seed in fresh_seeds(self.finding)])

    def _best(self) -> Case:
        best = self.finding.best
        assert best is not None
        return best

    def _cost(self, case: Case) -> float:
        if case.spoils:
            return case.severity
        return math.sqrt(self.count) + 1.0 - case.badness

    def _judge(self, points: Sequence[Point], step: str) -> list[Case]:
        """Fly each point's seeds, all points together, until most agree."""
        finding = self.finding
        overrides = [self.space.overrides(point) for point in points]
        rows: list[list[Row]] = [[] for _ in points]
        needed = len(finding.seeds) // 2 + 1
        for turn, _ in enumerate(finding.seeds):
            undecided = [
                index for index in range(len(points)) if self._undecided(rows[index], needed)
            ]
            flights = [(overrides[index], finding.seeds[turn]) for index in undecided]
            for index, row in zip(undecided, self.book.fly(flights), strict=True):
                rows[index].append(row)
        cases = []
        for point, flown in zip(points, rows, strict=True):
            shares = [self._share(row) for row in flown]
            spoils = sum(missed(row, finding.miss) for row in flown) >= needed
            case = Case(
                point=point.copy(),
                severity=self.space.severity(point),
                rows=flown,
                spoils=spoils,
                badness=float(np.mean(shares)),
                asked=self.book.asked,
                step=step,
            )
            cases.append(case)
            finding.cases.append(case)
            milder = finding.best is None or case.severity < finding.best.severity
            if spoils and milder and step != "undisturbed":
                finding.best = case
                self.book.note(f"severity {case.severity:.2f}")
        return cases

    def _undecided(self, rows: list[Row], needed: int) -> bool:
        bad = sum(missed(row, self.finding.miss) for row in rows)
        return bad < needed and len(rows) - bad <= len(self.finding.seeds) - needed

    def _share(self, row: Row) -> float:
        if row["status"] != "done" or not row["took_off"]:
            return 0.0
        if not row["landed"]:
            return 1.0
        return min(float(row["landing_error_m"]) / self.finding.miss, 1.0)
