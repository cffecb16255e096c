"""A study: what varies, what is measured, and which runs that makes.

A study is a dataclass and a YAML file in `studies/definitions`. Its conditions
are its variants times its grid points. Runs are numbered through: run
``n`` is condition ``n mod C`` of pair ``n div C``, so that every pair shows
each condition the same world, and more runs only ever follow those that are
already there.
"""

import dataclasses
import difflib
import hashlib
import itertools
import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

import pydantic
from pydantic import Field, model_validator
from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError

from diagrams.loading import ScenarioError, validate
from studies.sampling import Distribution, hashed, hashed_uniform
from systems.configuration import configuration


class StudyError(Exception):
    """A study that cannot be defined, flown or stored; its text is one sentence for the user."""


@configuration
class Variant:
    """A named set of overrides: one row of a table."""

    label: str = ""  # what tables and figures call it; empty: its name
    group: str = ""  # variants of one group share a colour and a row of figures
    overrides: dict[str, Any] = Field(default_factory=dict)  # dotted scenario path: value
    # Instead of the study's for the same path, from the same draw of the pair.
    distributions: dict[str, Distribution] = Field(default_factory=dict)
    published: str | None = None  # the key of `studies.published` it is held against


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
    """One variant at one point of the grids."""

    variant: str
    point: dict[str, Any]  # dotted path: value
    label: str


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

    The study's own overrides hold for every run; those of its variant come on
    top, and so do distributions. What a grid varies is set by nothing else, and no path
    has both a value and a distribution.
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
    grids: dict[str, Annotated[list[Any], Field(min_length=1)]] = Field(default_factory=dict)
    distributions: dict[str, Distribution] = Field(default_factory=dict)
    measures: Measures = Field(default_factory=Measures)
    # Columns of a run's result that differ from time to time: kept apart in timings.parquet.
    volatile: list[str] = Field(default_factory=lambda: ["cpu_s"])

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
    def conditions(self) -> list[Condition]:
        """Variants times grid points, in the order of the file, the last grid fastest."""
        variants = self.variants or {"default": Variant(label=self.scenario)}
        points = [
            dict(zip(self.grids, values, strict=True))
            for values in itertools.product(*self.grids.values())
        ]
        conditions = []
        for name, variant in variants.items():
            for point in points:
                at = ", ".join(f"{path} = {value}" for path, value in point.items())
                label = variant.label or name
                if at:
                    label = f"{label}, {at}" if self.variants else at
                conditions.append(Condition(name, point, label))
        return conditions

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
        return json.dumps(
            definition, sort_keys=True, separators=(",", ":"), allow_nan=False, ensure_ascii=False
        )

    @property
    def digest(self) -> str:
        """The hash of `canonical`, 32 hexadecimal digits."""
        return hashlib.blake2b(self.canonical.encode(), digest_size=16).hexdigest()

    def run_spec(self, run: int) -> RunSpec:
        """What run number `run` flies."""
        conditions, digest = self.conditions, self.digest
        pair, place = divmod(run, len(conditions))
        condition = conditions[place]
        variant = self.variants.get(condition.variant, _AS_IT_IS)
        drawn = {
            path: law.quantile(hashed_uniform(digest, pair, path))
            for path, law in (self.distributions | variant.distributions).items()
        }
        varied = condition.point | drawn
        return RunSpec(
            run=run,
            pair=pair,
            condition=condition,
            varied=varied,
            overrides=self.overrides | variant.overrides | varied,
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
