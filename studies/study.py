"""A study: what varies, what is measured, and which runs that makes.

A study is a dataclass and a YAML file in `studies/definitions`. Its cells are its
variants times the levels of its axes times its grid points; cells that fly the same by
construction are one condition. Runs are numbered through, pair by pair: all runs of a
pair show each condition the same world, and more runs only ever follow those that are
already there. Without conditions that are flown more rarely, run ``n`` is condition
``n mod C`` of pair ``n div C``.
"""

import dataclasses
import difflib
import hashlib
import itertools
import json
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

import pydantic
from pydantic import Field, model_validator
from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError

from diagrams.loading import ScenarioError, validate
from studies.sampling import Distribution, hashed, hashed_uniform
from systems.configuration import Positive, Probability, configuration


class StudyError(Exception):
    """A study that cannot be defined, flown or stored; its text is one sentence for the user."""


@configuration
class Variant:
    """A named set of overrides: one row of a table."""

    label: str = ""  # what tables and figures call it; empty: its name
    group: str = ""  # variants of one group share a colour and a row of figures
    overrides: dict[str, Any] = Field(default_factory=dict)  # dotted scenario path: value
    # Paths that mean nothing to it, besides those that are null: no axis sets them or what is
    # below them, and cells that differ in nothing else are one condition.
    lacks: list[str] = Field(default_factory=list)
    every: Annotated[int, Field(ge=1)] = 1  # flown in every so manyth pair alone
    # Instead of the study's for the same path, from the same draw of the pair.
    distributions: dict[str, Distribution] = Field(default_factory=dict)
    published: str | None = None  # the key of `studies.published` it is held against


@configuration
class Level:
    """One place on an axis."""

    label: str = ""  # what tables and figures call it; empty: its name
    overrides: dict[str, Any] = Field(default_factory=dict)  # dotted scenario path: value
    every: Annotated[int, Field(ge=1)] = 1  # flown in every so manyth pair alone
    without: list[str] = Field(default_factory=list)  # variants that have no such cell


@configuration
class Axis:
    """Something that varies in steps, by name or by number.

    Later axes, and within an axis later paths, write over earlier ones: a value that
    replaces a whole field voids what was said of its parts.
    """

    label: str = ""  # with its unit; empty: its name
    levels: dict[str, Level] = Field(default_factory=dict)  # by name
    # Or numbers, and what they set: dotted path and the factor from the axis's unit to the field's
    values: list[float] = Field(default_factory=list)
    paths: dict[str, float] = Field(default_factory=dict)
    without: list[str] = Field(default_factory=list)  # variants that do not have this axis: they
    # fly its first level alone

    @model_validator(mode="after")
    def _either(self) -> "Axis":
        if bool(self.levels) == bool(self.values):
            raise ValueError("expected either levels or values")
        if bool(self.values) != bool(self.paths):
            raise ValueError("expected values together with the paths that they set")
        return self

    @property
    def steps(self) -> dict[str, Level]:
        """The levels by name, those of numbers too."""
        if self.levels:
            return self.levels
        return {
            f"{value:g}": Level(
                overrides={path: _scaled(value, factor) for path, factor in self.paths.items()}
            )
            for value in self.values
        }

    def numbers(self) -> list[float] | None:
        """Where the steps lie, if they are numbers: by `values`, or by their names."""
        try:
            return self.values or [float(name) for name in self.levels]
        except ValueError:
            return None

    def only(self, names: Sequence[str]) -> "Axis":
        """The axis with these of its steps."""
        if unknown := sorted(set(names) - set(self.steps)):
            raise ValueError(f"there is no level {unknown[0]!r}")
        return dataclasses.replace(
            self,
            levels={name: level for name, level in self.levels.items() if name in names},
            values=[value for value in self.values if f"{value:g}" in names],
        )


@configuration
class Quick:
    """A look at a study that takes minutes: fewer cells, fewer runs."""

    runs: Annotated[int, Field(ge=1)]
    levels: dict[str, list[str]] = Field(default_factory=dict)  # axis: the levels that stay
    variants: list[str] = Field(default_factory=list)  # that stay; none named: all


@configuration
class Budget:
    """The rule behind a sentence like "an unmodelled 120 ms costs 10 cm"."""

    axis: str  # along which; its first level is undisturbed
    loss: Positive = 0.1  # m, by which the mean error has grown over the undisturbed cell
    success: Probability = 0.95  # or fewer than this land


@configuration
class Promise:
    """What touchdowns are held to; how often they keep it is told for every cell."""

    within: Positive  # m
    # target: of where it should have landed. first_level: of where the run of the same pair touched
    # down at the first level of the last axis, that is undisturbed
    of: Literal["target", "first_level"] = "target"


@configuration
class Measures:
    """Which columns of a run's result the summary is about."""

    success: str = "landed"  # bool
    error: str = "landing_error_m"  # m, from where it should have landed
    x: str = "landing_x_m"  # m, touchdown from there
    y: str = "landing_y_m"  # m
    time: str = "landing_time_s"  # s, from the start of the landing routine
    others: list[str] = Field(default_factory=list)  # more numbers to summarise

    def numbers(self) -> list[str]:
        """The columns that get a row of statistics."""
        return [self.error, self.time, *self.others]

    def columns(self) -> list[str]:
        """Every column that a run must give."""
        return [self.success, self.error, self.x, self.y, self.time, *self.others]


@dataclass(frozen=True)
class Condition:
    """One variant at one point of axes and grids."""

    variant: str
    point: dict[str, Any]  # dotted path: value, of the grids
    label: str
    levels: dict[str, str] = dataclasses.field(default_factory=dict)  # axis: level
    overrides: dict[str, Any] = dataclasses.field(default_factory=dict)  # all but distributions
    every: int = 1  # flown in pairs that are multiples of this


@dataclass(frozen=True)
class Cell:
    """One entry of a map or a table, and the condition whose runs it shows."""

    variant: str
    levels: dict[str, str]  # axis: level
    condition: Condition


class _Plan:
    """The cells of a study, and the order in which its conditions are flown.

    After `period` pairs everything repeats; `block` is the pair and the condition of their runs.
    """

    def __init__(self, cells: list[Cell]):
        self.cells = cells
        self.conditions = list({id(cell.condition): cell.condition for cell in cells}.values())
        self.period = math.lcm(*(condition.every for condition in self.conditions))
        self.block = [
            (pair, condition)
            for pair in range(self.period)
            for condition in self.conditions
            if pair % condition.every == 0
        ]


@dataclass(frozen=True)
class RunSpec:
    """Everything that decides one run."""

    run: int
    pair: int  # runs of one pair share the seed and the draws
    condition: Condition
    varied: dict[str, Any]  # dotted path: value, from grids and distributions
    overrides: dict[str, Any]  # dotted path: value, all of them
    seed: int


@configuration
class Study:
    """Many runs of one scenario.

    It is not changed once it is made (`dataclasses.replace` makes another): its cells are listed
    and its hash is taken once. The study's own overrides hold for every run; those of its variant
    come on top, then those of its axes, and so do distributions. What a grid varies is set by
    nothing else, and no path has both a value and a distribution.
    """

    name: Annotated[str, Field(min_length=1)]
    description: str = ""
    scenario: str  # the name of a scenario, or the path of a YAML file
    # module:class, see `studies.executors`
    experiment: str = "studies.landing_experiment:LandingExperiment"
    seed: int = 0  # of the whole campaign
    runs: Annotated[int, Field(ge=1)] = 100  # of all conditions together, unless said
    overrides: dict[str, Any] = Field(default_factory=dict)  # dotted scenario path: value
    variants: dict[str, Variant] = Field(default_factory=dict)  # none: the scenario as it is
    axes: dict[str, Axis] = Field(default_factory=dict)
    grids: dict[str, Annotated[list[Any], Field(min_length=1)]] = Field(default_factory=dict)
    distributions: dict[str, Distribution] = Field(default_factory=dict)
    measures: Measures = Field(default_factory=Measures)
    # Columns of a run's result that differ from time to time: kept apart in timings.parquet.
    volatile: list[str] = Field(default_factory=lambda: ["cpu_s"])
    quick: Quick | None = None
    # How a study with axes is shown. maps: the last two axes by variant; curves: a line a variant
    # over the last axis; table: variants beside each other over the last axis; distributions: the
    # same table, and a box a cell instead of its mean
    layout: Literal["maps", "curves", "table", "distributions"] = "maps"
    budgets: list[Budget] = Field(default_factory=list)  # told in words, of a study with axes
    promises: list[Promise] = Field(default_factory=list)  # counted, of a study with axes

    @model_validator(mode="after")
    def _unambiguous(self) -> "Study":
        grids, own = ("grids", set(self.grids)), ("overrides", set(self.overrides))
        laws = ("distributions", set(self.distributions))
        rivals = [(grids, own), (grids, laws), (own, laws)]
        for name, variant in self.variants.items():
            values = (f"variants.{name}.overrides", set(variant.overrides))
            drawn = (f"variants.{name}.distributions", set(variant.distributions))
            rivals += [(grids, values), (grids, drawn), (laws, values), (own, drawn)]
            rivals += [(values, drawn)]
        for name, axis in self.axes.items():
            steps = axis.steps.values()
            stepped = (f"axes.{name}", {path for step in steps for path in step.overrides})
            rivals += [(stepped, grids), (stepped, laws)]
            without = {*axis.without, *(other for step in steps for other in step.without)}
            if unknown := sorted(without - set(self.variants)):
                raise ValueError(f"axes.{name}: there is no variant {unknown[0]!r}")
        for budget in self.budgets:
            if budget.axis not in self.axes:
                raise ValueError(f"budgets: there is no axis {budget.axis!r}")
        if self.promises and not self.axes:
            raise ValueError("promises: expected a study with axes")
        for (first, left), (second, right) in rivals:
            if common := sorted(left & right):
                raise ValueError(f"{common[0]} is set by {first} and by {second}: expected one")
        labels = Counter(condition.label for condition in self.conditions)
        if double := [label for label, count in labels.items() if count > 1]:
            raise ValueError(f"two conditions are called {double[0]!r}: expected one of a name")
        return self

    def varied_paths(self) -> list[str]:
        """Every dotted path that a grid or a distribution varies."""
        laws = [self.distributions, *(v.distributions for v in self.variants.values())]
        return list(dict.fromkeys([*self.grids, *(path for law in laws for path in law)]))

    @property
    def drawn_by_cell(self) -> bool:
        """Whether figures show the cells of axes, and not the distribution of each condition."""
        return bool(self.axes) and self.layout != "distributions"

    @property
    def conditions(self) -> list[Condition]:
        """What is flown, in the order of the file, the last grid fastest."""
        return self._plan.conditions

    @property
    def cells(self) -> list[Cell]:
        """Variants times levels times grid points, each with the condition that it shows."""
        return self._plan.cells

    @cached_property
    def _plan(self) -> "_Plan":
        cells, flown = [], dict[str, Condition]()
        for name, variant in (self.variants or {"default": Variant(label=self.scenario)}).items():
            for steps in itertools.product(*(axis.steps for axis in self.axes.values())):
                levels = dict(zip(self.axes, steps, strict=True))
                if not self._has(name, levels):
                    continue
                for point in self._points():
                    condition = self._condition(name, variant, levels, point)
                    same = json.dumps([name, condition.overrides], sort_keys=True)
                    if self.axes:
                        condition = flown.setdefault(same, condition)
                    cells.append(Cell(name, levels, condition))
        return _Plan(cells)

    def _has(self, variant: str, levels: Mapping[str, str]) -> bool:
        for name, axis in self.axes.items():
            first = next(iter(axis.steps))
            if variant in axis.without and levels[name] != first:
                return False
            if variant in axis.steps[levels[name]].without:
                return False
        return True

    def _points(self) -> list[dict[str, Any]]:
        return [
            dict(zip(self.grids, values, strict=True))
            for values in itertools.product(*self.grids.values())
        ]

    def _condition(
        self, name: str, variant: Variant, levels: dict[str, str], point: dict[str, Any]
    ) -> Condition:
        own = self.overrides | variant.overrides
        absent = (*variant.lacks, *(path for path, value in own.items() if value is None))
        steps = {axis: self.axes[axis].steps[step] for axis, step in levels.items()}
        parts = [variant.label or name] if self.variants or not (levels or point) else []
        overrides = own
        for axis, step in steps.items():
            if len(self.axes[axis].steps) > 1:
                parts.append(step.label or f"{axis} {levels[axis]}")
            for path, value in step.overrides.items():
                if not any(_within(path, gone) for gone in absent):
                    overrides = _replaced(overrides, path, value)
        parts += [f"{path} = {value}" for path, value in point.items()]
        return Condition(
            name,
            point,
            ", ".join(parts),
            levels,
            overrides | point,
            math.lcm(variant.every, *(step.every for step in steps.values())),
        )

    def runs_of(self, pairs: int) -> int:
        """How many runs the first `pairs` pairs are."""
        return sum(-(-pairs // condition.every) for condition in self.conditions)

    def quick_look(self) -> "Study":
        """The study cut down to minutes, a study of its own.

        Raises
        ------
        StudyError
            It says nothing of a quick look.
        """
        if self.quick is None:
            raise StudyError(f"study {self.name} has no quick look: give a number of runs")
        try:
            axes = {
                name: axis.only(self.quick.levels[name]) if name in self.quick.levels else axis
                for name, axis in self.axes.items()
            }
        except ValueError as error:
            raise StudyError(f"study {self.name}: quick: {error}") from None
        kept = self.quick.variants or list(self.variants)
        variants = {name: variant for name, variant in self.variants.items() if name in kept}
        return dataclasses.replace(self, axes=axes, variants=variants, runs=self.quick.runs)

    @property
    def canonical(self) -> str:
        """What decides the runs, as JSON in one fixed form.

        Left out is what does not: the number of runs, texts, and what is measured.
        """
        definition = {
            "name": self.name,
            "scenario": self.scenario,
            "experiment": self.experiment,
            "seed": self.seed,
            "overrides": self.overrides,
            # Lists, because the order of variants, grids and grid values numbers the runs.
            "variants": [
                [name, variant.overrides, _laws(variant.distributions)]
                for name, variant in self.variants.items()
            ],
            "grids": [[path, values] for path, values in self.grids.items()],
            "distributions": _laws(self.distributions),
        }
        if self.axes:
            definition["cells"] = [
                [cell.variant, cell.levels, cell.condition.overrides, cell.condition.every]
                for cell in self.cells
            ]
        return json.dumps(
            definition, sort_keys=True, separators=(",", ":"), allow_nan=False, ensure_ascii=False
        )

    @cached_property
    def digest(self) -> str:
        """The hash of `canonical`, 32 hexadecimal digits."""
        return hashlib.blake2b(self.canonical.encode(), digest_size=16).hexdigest()

    def run_spec(self, run: int) -> RunSpec:
        """What run number `run` flies."""
        plan = self._plan
        turn, place = divmod(run, len(plan.block))
        offset, condition = plan.block[place]
        pair = turn * plan.period + offset
        digest = self.digest
        variant = self.variants.get(condition.variant, _AS_IT_IS)
        drawn = {
            path: law.quantile(hashed_uniform(digest, pair, path))
            for path, law in (self.distributions | variant.distributions).items()
        }
        return RunSpec(
            run=run,
            pair=pair,
            condition=condition,
            varied=condition.point | drawn,
            overrides=condition.overrides | drawn,
            seed=hashed(digest, pair),
        )

    def run_specs(self, runs: int | None = None) -> Iterator[RunSpec]:
        """The first `runs` runs (default: the study's own number)."""
        return map(self.run_spec, range(self.runs if runs is None else runs))

    def to_json(self) -> str:
        """The whole definition as JSON, which `from_json` reads back."""
        return pydantic.TypeAdapter(Study).dump_json(self, indent=2).decode()

    @staticmethod
    def from_json(text: str) -> "Study":
        """A study from `to_json`."""
        study: Study = pydantic.TypeAdapter(Study).validate_json(text)
        return study


_AS_IT_IS = Variant()


def _within(path: str, parent: str) -> bool:
    return path == parent or path.startswith(f"{parent}.")


def _replaced(overrides: Mapping[str, Any], path: str, value: Any) -> dict[str, Any]:
    """`overrides` with one more on top; what replaces a whole field voids its parts."""
    whole = not isinstance(value, dict) or "kind" in value  # another map is merged into the field
    kept = {
        other: said
        for other, said in overrides.items()
        if other != path and not (whole and _within(other, path))
    }
    return {**kept, path: value}


def _scaled(value: float, factor: float) -> float:
    return round(value * factor, 12)


def _laws(distributions: dict[str, Distribution]) -> dict[str, Any]:
    return {path: dataclasses.asdict(law) for path, law in distributions.items()}


def list_studies() -> dict[str, Study]:
    """The studies that come with the laboratory, by name, sorted."""
    return {name: load_study(name) for name in study_names()}


def study_names() -> list[str]:
    """The names of the studies that come with the laboratory, sorted."""
    return sorted(
        entry.name.removesuffix(".yaml")
        for entry in (resources.files("studies") / "definitions").iterdir()
        if entry.name.endswith(".yaml")
    )


def load_study(name: str | Path) -> Study:
    """Load and validate a study.

    Parameters
    ----------
    name : str or Path
        The name of a study of the laboratory, or the path of a YAML file.

    Raises
    ------
    StudyError
        File, field, what was expected and the nearest valid name, in one sentence.
    """
    source, text = _read(name)
    try:
        tree = YAML().load(text)
    except MarkedYAMLError as error:
        line = f", line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise StudyError(f"{source}{line}: not YAML: {error.problem}") from None
    except YAMLError as error:
        raise StudyError(f"{source}: not YAML: {str(error).splitlines()[0]}") from None
    if not isinstance(tree, dict):
        raise StudyError(f"{source}: expected the fields of a study")
    tree.setdefault("name", Path(source).stem)
    try:
        study: Study = validate(Study, tree, source)
    except ScenarioError as error:
        raise StudyError(str(error)) from None
    return study


def _read(name: str | Path) -> tuple[str, str]:
    names = study_names()
    if str(name) in names:
        entry = resources.files("studies") / "definitions" / f"{name}.yaml"
        return f"studies/definitions/{name}.yaml", entry.read_text(encoding="utf-8")
    path = Path(name)
    if path.suffix not in (".yaml", ".yml"):
        close = difflib.get_close_matches(str(name), names, n=1, cutoff=0.4)
        hint = f"; the nearest is {close[0]}" if close else ""
        raise StudyError(
            f"{name}: no study of that name, expected one of {', '.join(names)} "
            f"or a YAML file{hint}"
        )
    try:
        return str(path), path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise StudyError(f"{path}: expected YAML text in UTF-8, found other bytes") from None
    except OSError as error:
        raise StudyError(f"{path}: cannot be read: {error.strerror}") from None
