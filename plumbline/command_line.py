"""`plumbline`: land, replay, study, falsify, sensitivity, graph, scenarios.

Exit status: 0 landed (or done), 1 not landed, 2 wrong input, told in one sentence.
Heavy modules are imported inside the commands so that `--help` answers at once.
"""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

DEFAULT_SCENARIO = "infrared-and-marker"
WRONG_INPUT = 2


class WrongInput(click.ClickException):
    """Wrong input: one sentence on standard error, exit status 2."""

    exit_code = WRONG_INPUT

    def show(self, file: Any = None) -> None:
        """Print the sentence."""
        click.echo(f"plumbline: {self.message}", err=True)


def _scenario_options(command: Callable) -> Callable:
    command = click.option(
        "--set",
        "overrides",
        metavar="FIELD.PATH=VALUE",
        multiple=True,
        help="Change a field of the scenario, e.g. --set wind.speed=5; repeatable.",
    )(command)
    return click.argument("scenario", default=DEFAULT_SCENARIO)(command)


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(package_name="plumbline")
def cli() -> None:
    """Precision landings on Drake: what latency, gate, fault or wind can yours survive?"""


@cli.command()
@_scenario_options
@click.option(
    "--seed", type=click.IntRange(min=0), help="Seed of all noise; the scenario's own if not given."
)
@click.option(
    "--fidelity",
    type=click.Choice(["pixels", "geometric"]),
    help="Cameras by real images or by an error model.",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    help="Folder for run.json, log.parquet, report.html.  [default: out/SCENARIO-SEED]",
)
@click.option(
    "--live", is_flag=True, help="Show the flight in Meshcat, at real-time rate, while it happens."
)
@click.option("--from", "from_", metavar="DIR/RUN", help="Repeat exactly one run of a campaign.")
@click.option("--report/--no-report", default=True, show_default=True, help="Write report.html.")
def land(
    scenario: str,
    overrides: tuple[str, ...],
    seed: int | None,
    fidelity: str | None,
    out: Path | None,
    live: bool,
    from_: str | None,
    report: bool,
) -> None:
    """Fly SCENARIO once, to the touchdown.

    SCENARIO is a name from `plumbline scenarios` or a YAML file.
    """
    extra = [*overrides]
    if from_ is not None:
        scenario, repeated = _run_of_campaign(from_)
        extra = [*repeated, *extra]
    if seed is not None:
        extra.append(f"seed={seed}")
    if fidelity is not None:
        extra.append(f"fidelity={fidelity}")
    loaded = _load(scenario, extra)
    folder = _writable_folder(out or Path("out") / f"{loaded.name}-{loaded.seed}")

    from diagrams.loading import ScenarioError
    from runs.flight import fly_and_report

    try:
        result = fly_and_report(loaded, folder, live=live, report=report)
    except ScenarioError as error:
        raise WrongInput(str(error)) from None
    for sentence in result.sentences():
        click.echo(sentence)
    click.echo(f"Report: {folder / 'report.html'}" if report else f"Run: {folder / 'run.json'}")
    sys.exit(0 if result.landed else 1)


@cli.command()
@_scenario_options
@click.option(
    "--depth", type=click.IntRange(min=0), help="Levels of sub-diagrams to open; all if not given."
)
@click.option("--states", is_flag=True, help="Draw the supervisor's states instead of the wiring.")
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("graph.svg"),
    show_default=True,
    help="A .dot, .svg or .png file.",
)
def graph(
    scenario: str, overrides: tuple[str, ...], depth: int | None, states: bool, out: Path
) -> None:
    """Draw the wiring of SCENARIO, or its supervisor's states."""
    loaded = _load(scenario, overrides)

    from diagrams.graph import GraphError, wiring_dot, write_graph
    from diagrams.loading import ScenarioError
    from runs.run import laboratory

    try:
        built = laboratory(loaded).landing
    except ScenarioError as error:
        raise WrongInput(str(error)) from None
    dot = built.states_dot() if states else wiring_dot(built.diagram, depth)
    try:
        write_graph(dot, out)
    except GraphError as error:
        raise WrongInput(str(error)) from None
    except OSError as error:
        raise WrongInput(f"{out}: cannot be written: {error.strerror}") from None
    click.echo(f"Graph: {out}")


@cli.command()
@click.argument("name", required=False)
def scenarios(name: str | None) -> None:
    """List the scenarios; with NAME, print that scenario with every field."""
    from diagrams.loading import scenario_names, to_yaml

    if name is not None:
        click.echo(to_yaml(_load(name, ())), nl=False)
        return
    names = scenario_names()
    width = max(len(entry) for entry in names)
    for entry in names:
        click.echo(f"{entry:{width}}  {_load(entry, ()).description}")


@cli.command()
@click.argument("words", nargs=-1, metavar="NAME | resume DIR")
@click.option("--list", "list_", is_flag=True, help="List the studies.")
@click.option("--runs", type=click.IntRange(min=1), help="Landings, all variants together.")
@click.option("--quick", is_flag=True, help="A look of minutes: fewer cells, fewer landings.")
@click.option("--workers", type=click.IntRange(min=0), help="Processes.  [default: one a core]")
@click.option("--seed", type=click.IntRange(min=0), help="Seed of the campaign.")
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    help="Folder of the campaign.  [default: out/studies/NAME]",
)
@click.option("--scheduler", help="Address of a Dask scheduler whose workers fly, tcp://HOST:PORT.")
def study(
    words: tuple[str, ...],
    list_: bool,
    runs: int | None,
    quick: bool,
    workers: int | None,
    seed: int | None,
    out: Path | None,
    scheduler: str | None,
) -> None:
    """Fly the study NAME (or a YAML file), or go on with the campaign in DIR."""
    from studies.campaign import resume, run_study
    from studies.study import StudyError, list_studies, load_study

    if list_:
        known = list_studies()
        width = max(len(name) for name in known)
        for name, entry in known.items():
            click.echo(f"{name:{width}}  {' '.join(entry.description.split())}")
        return
    try:
        match words:
            case ("resume", campaign):
                result = resume(Path(campaign), workers, scheduler)
            case (name,) if name != "resume":
                chosen = load_study(name).quick_look() if quick else load_study(name)
                own = f"{chosen.name}-quick" if quick else Path(name).stem
                folder = out or Path("out") / "studies" / own
                result = run_study(chosen, folder, runs, workers, seed, scheduler)
            case _:
                raise WrongInput("study: expected the NAME of a study, or: resume DIR")
    except StudyError as error:
        raise WrongInput(str(error)) from None
    click.echo(f"{result.done} of {result.runs} runs")
    if not result.complete:
        click.echo(f"To go on: plumbline study resume {result.folder}")
    click.echo(f"Report: {result.folder / 'report.html'}")
    sys.exit(0 if result.complete else 1)


def _search_options(command: Callable) -> Callable:
    """What the searches over disturbances have in common."""
    for option in (
        click.option(
            "--vary",
            metavar="NAME,NAME…",
            help="Disturbances, see --list.  [default: wind,gust,latency,dropout,drops]",
        ),
        click.option(
            "--limit",
            "limits",
            metavar="NAME=VALUE",
            multiple=True,
            help="Another limit of a disturbance, e.g. --limit wind=10; repeatable.",
        ),
        click.option("--list", "list_", is_flag=True, help="List the disturbances."),
        click.option(
            "--fidelity",
            type=click.Choice(["pixels", "geometric"]),
            default="geometric",
            show_default=True,
            help="Cameras by real images or by an error model.",
        ),
        click.option(
            "--seed",
            type=click.IntRange(min=0),
            default=1,
            show_default=True,
            help="Of the search and its flights.",
        ),
        click.option(
            "--workers", type=click.IntRange(min=0), help="Processes.  [default: one a core]"
        ),
    ):
        command = option(command)
    return _scenario_options(command)


@cli.command()
@_search_options
@click.option("--budget", type=click.IntRange(min=1), default=300, show_default=True)
@click.option(
    "--miss",
    type=float,
    default=0.5,
    show_default=True,
    help="m; a landing farther off is spoiled.",
)
@click.option(
    "--seeds",
    type=click.IntRange(min=1),
    default=3,
    show_default=True,
    help="Flights that judge a case; it is spoiled if most of them are.",
)
@click.option(
    "--out", type=click.Path(path_type=Path), help="Folder.  [default: out/falsify/SCENARIO]"
)
def falsify(
    scenario: str,
    overrides: tuple[str, ...],
    vary: str | None,
    limits: tuple[str, ...],
    list_: bool,
    fidelity: str,
    seed: int,
    workers: int | None,
    budget: int,
    miss: float,
    seeds: int,
    out: Path | None,
) -> None:
    """Search for the mildest disturbance that spoils the landing of SCENARIO.

    Writes it as a scenario, case.yaml, with a report. Ctrl-C leaves the best case so far; the same
    command goes on.
    """
    if list_:
        _list_disturbances()
        return
    from studies.falsification import falsify as search
    from studies.study import StudyError

    folder = _writable_folder(out or Path("out") / "falsify" / Path(scenario).stem)
    try:
        finding = search(
            scenario,
            folder,
            _disturbances(vary),
            budget,
            overrides=_flight_overrides(scenario, overrides, fidelity),
            limits=_limits(limits),
            miss=miss,
            seeds=seeds,
            seed=seed,
            workers=workers,
        )
    except StudyError as error:
        raise WrongInput(str(error)) from None
    click.echo(finding.sentence())
    if finding.interrupted:
        click.echo(f"Interrupted after {finding.asked} flights; the same command goes on")
    if finding.best is not None:
        click.echo(f"To fly it: plumbline land {folder / 'case.yaml'}")
    click.echo(f"Report: {folder / 'report.html'}")
    sys.exit(1 if finding.interrupted else 0)


@cli.command()
@_search_options
@click.option("--runs", type=click.IntRange(min=1), default=300, show_default=True)
@click.option(
    "--method", type=click.Choice(["morris", "sobol"]), default="morris", show_default=True
)
@click.option(
    "--out", type=click.Path(path_type=Path), help="Folder.  [default: out/sensitivity/SCENARIO]"
)
def sensitivity(
    scenario: str,
    overrides: tuple[str, ...],
    vary: str | None,
    limits: tuple[str, ...],
    list_: bool,
    fidelity: str,
    seed: int,
    workers: int | None,
    runs: int,
    method: Any,
    out: Path | None,
) -> None:
    """Rank the disturbances by what they do to the landing of SCENARIO.

    Ctrl-C keeps what is flown; the same command goes on.
    """
    if list_:
        _list_disturbances()
        return
    from studies.sensitivity import analyse
    from studies.study import StudyError

    folder = _writable_folder(out or Path("out") / "sensitivity" / Path(scenario).stem)
    try:
        analysis = analyse(
            scenario,
            folder,
            _disturbances(vary),
            runs,
            method,
            overrides=_flight_overrides(scenario, overrides, fidelity),
            limits=_limits(limits),
            seed=seed,
            workers=workers,
        )
    except StudyError as error:
        raise WrongInput(str(error)) from None
    if analysis is None:
        click.echo("Interrupted; the same command goes on")
        sys.exit(1)
    for sentence in analysis.sentences():
        click.echo(sentence)
    click.echo(f"Report: {folder / 'report.html'}")


def _disturbances(text: str | None) -> list[str]:
    """The names of a list with commas, or the default's."""
    from studies.falsification import DEFAULT_DISTURBANCES

    if text is None:
        return list(DEFAULT_DISTURBANCES)
    return [name.strip() for name in text.split(",") if name.strip()]


def _flight_overrides(scenario: str, overrides: tuple[str, ...], fidelity: str) -> dict[str, Any]:
    """The overrides of every flight of a search, once the scenario has been found valid."""
    from diagrams.loading import parse_overrides

    loaded = _load(scenario, overrides)
    cameras = {"fidelity": fidelity} if hasattr(loaded, "fidelity") else {}
    return {**cameras, **parse_overrides(overrides)}


def _limits(texts: tuple[str, ...]) -> dict[str, float]:
    limits = {}
    for text in texts:
        name, _, value = text.partition("=")
        try:
            limits[name.strip()] = float(value)
        except ValueError:
            raise WrongInput(f"--limit {text}: expected NAME=NUMBER, as in wind=10") from None
    return limits


def _list_disturbances() -> None:
    from studies.disturbances import DISTURBANCES

    width = max(len(name) for name in DISTURBANCES)
    for name, entry in DISTURBANCES.items():
        unit = f" ({entry.unit})" if entry.unit else ""
        click.echo(f"{name:{width}}  {entry.text}{unit}; limit: {entry.source}")


@cli.command()
@click.argument("log", type=click.Path(path_type=Path))
@click.option(
    "--out", type=click.Path(path_type=Path), help="Folder of the results.  [default: out/replay]"
)
@click.option(
    "--param",
    "overrides",
    metavar="NAME=VALUE",
    multiple=True,
    help="Change a parameter, e.g. --param EKF2_EV_DELAY=200; repeatable.",
)
@click.option("--params", "file", type=click.Path(path_type=Path), help="A QGroundControl file.")
@click.option("--defaults", type=click.Choice(["module", "unit-test"]), default="module")
@click.option(
    "--start",
    type=click.Choice(["warm", "cold"]),
    default="warm",
    show_default=True,
    help="From the state of the filter on board when the log began, if it is logged; or anew.",
)
@click.option(
    "--sweep",
    metavar="NAME=FIRST:LAST:STEP",
    help="Try a parameter at many values and replay with the best.",
)
@click.option("--report/--no-report", default=True, show_default=True, help="Write report.html.")
def replay(
    log: Path,
    out: Path | None,
    overrides: tuple[str, ...],
    file: Path | None,
    defaults: Any,
    start: Any,
    sweep: str | None,
    report: bool,
) -> None:
    """Run PX4's EKF2 on the sensors of LOG, a ULog or a CSV stream."""
    folder = _writable_folder(out or Path("out") / "replay")

    from runs.log_sources import ReplayError
    from runs.replay_run import replay_and_report

    try:
        sentences = replay_and_report(log, folder, overrides, file, defaults, sweep, report, start)
    except ReplayError as error:
        raise WrongInput(str(error)) from None
    for sentence in sentences:
        click.echo(sentence)
    click.echo(f"Report: {folder / 'report.html'}" if report else f"Replay: {folder}")


def _load(scenario: str, overrides: Any) -> Any:
    from diagrams.loading import ScenarioError, load_scenario

    try:
        return load_scenario(scenario, overrides)
    except ScenarioError as error:
        raise WrongInput(str(error)) from None


def _run_of_campaign(reference: str) -> tuple[str, list[str]]:
    """The scenario of one run of a campaign, and its overrides as for --set."""
    from studies.campaign import read_run
    from studies.study import StudyError

    try:
        flown, run = read_run(reference)
    except StudyError as error:
        raise WrongInput(f"--from {reference}: {error}") from None
    overrides = {**run.overrides, "seed": run.seed}
    return flown.scenario, [f"{path}={json.dumps(value)}" for path, value in overrides.items()]


def _writable_folder(folder: Path) -> Path:
    """Make a folder and be sure that files can be written there, before anything long runs."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / ".plumbline-probe"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise WrongInput(f"--out {folder}: cannot be written: {error.strerror}") from None
    return folder


def main() -> None:
    """Entry point of the `plumbline` command."""
    cli(prog_name="plumbline")
