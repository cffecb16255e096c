"""Scenarios from YAML: layered, overridden from the shell, and refused in one clear sentence.

A scenario file is YAML with the fields of a scenario dataclass; `kind` says which
(`multirotor_landing` unless said), `extends: NAME` starts from another scenario.
Overrides are dotted paths: ``wind.speed=5``, ``sensors.gnss.sensor.kind=rtk``.
"""

import copy
import difflib
import functools
import io
import math
import types
import typing
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import pydantic
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap
from ruamel.yaml.error import MarkedYAMLError, YAMLError


class ScenarioError(ValueError):
    """A scenario that cannot be loaded; its text is one sentence for the user."""


def scenario_names() -> list[str]:
    """The names of the scenarios that come with the laboratory, sorted."""
    return sorted(
        entry.name.removesuffix(".yaml")
        for entry in resources.files("scenarios").iterdir()
        if entry.name.endswith(".yaml")
    )


def load_scenario(name: str | Path, overrides: Mapping[str, Any] | Sequence[str] = ()) -> Any:
    """Load and validate a scenario.

    Parameters
    ----------
    name : str or Path
        The name of a scenario of the laboratory, or the path of a YAML file.
    overrides : mapping or sequence of str
        Dotted field paths and their values, `{"wind.speed": 5}` or `["wind.speed=5"]`;
        the values of the latter form are read as YAML.

    Returns
    -------
    The scenario dataclass that the file's `kind` asks for.

    Raises
    ------
    ScenarioError
        File, field, what was expected and the nearest valid name, in one sentence.
    """
    from diagrams.scenario import SCENARIO_KINDS  # the dataclasses import every block

    source, tree = _read_layers(name, seen=())
    for path, value in parse_overrides(overrides).items():
        _set_path(source, tree, path, value)
    kind = tree.get("kind", "multirotor_landing")
    if kind not in SCENARIO_KINDS:
        raise ScenarioError(
            f"{source}: kind: {kind!r} is not a kind of scenario, expected one of "
            f"{', '.join(SCENARIO_KINDS)}{_nearest(str(kind), SCENARIO_KINDS)}"
        )
    return validate(SCENARIO_KINDS[kind], tree, source)


def validate(kind: type, tree: Mapping[str, Any], source: str) -> Any:
    """Build a configuration dataclass from plain data, or raise `ScenarioError`."""
    try:
        return pydantic.TypeAdapter(kind).validate_python(_completed(kind, _plain(tree)))
    except pydantic.ValidationError as error:
        raise ScenarioError(_sentence(error, kind, tree, source)) from None


def with_overrides(scenario: Any, overrides: Mapping[str, Any] | Sequence[str]) -> Any:
    """A copy of `scenario` with some fields changed, validated like a file."""
    tree = to_plain(scenario)
    for path, value in parse_overrides(overrides).items():
        _set_path("--set", tree, path, value)
    return validate(type(scenario), tree, "--set")


def to_plain(scenario: Any) -> dict[str, Any]:
    """A scenario as nested dicts and lists of numbers and strings."""
    return pydantic.TypeAdapter(type(scenario)).dump_python(scenario, mode="json")


def parse_overrides(overrides: Mapping[str, Any] | Sequence[str]) -> dict[str, Any]:
    """Overrides as a dictionary; raises `ScenarioError` for a text without ``=``."""
    if isinstance(overrides, Mapping):
        return dict(overrides)
    parsed: dict[str, Any] = {}
    for text in overrides:
        path, equals, value = text.partition("=")
        if not equals or not path.strip():
            raise ScenarioError(f"--set {text}: expected FIELD.PATH=VALUE, as in wind.speed=5")
        try:
            parsed[path.strip()] = _plain(YAML(typ="safe", pure=True).load(value))
        except YAMLError:
            raise ScenarioError(f"--set {text}: {value!r} is not a YAML value") from None
    return parsed


def _read_layers(name: str | Path, seen: tuple[str, ...]) -> tuple[str, dict[str, Any]]:
    """The merged tree of a scenario file and of those it extends."""
    source, text = _read(name)
    if source in seen:
        raise ScenarioError(f"{source}: extends: the file extends itself by way of {seen[-1]}")
    try:
        tree = YAML().load(text)
    except MarkedYAMLError as error:
        line = f", line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise ScenarioError(f"{source}{line}: not YAML: {error.problem}") from None
    except (YAMLError, ValueError) as error:
        raise ScenarioError(f"{source}: not YAML: {str(error).splitlines()[0]}") from None
    if tree is None:
        tree = CommentedMap()
    if not isinstance(tree, dict):
        raise ScenarioError(f"{source}: expected fields of a scenario, found {_describe(tree)}")
    base = tree.pop("extends", None)
    if base is None:
        return source, tree
    if not isinstance(base, str):
        raise ScenarioError(f"{source}: extends: expected the name of a scenario")
    beside = Path(source).parent / base
    _, merged = _read_layers(beside if beside.is_file() else base, (*seen, source))
    return source, _merge(merged, tree)


def _read(name: str | Path) -> tuple[str, str]:
    names = scenario_names()
    if str(name) in names:
        entry = resources.files("scenarios") / f"{name}.yaml"
        return f"scenarios/{name}.yaml", entry.read_text(encoding="utf-8")
    path = Path(name)
    if path.suffix not in (".yaml", ".yml") and not path.exists():
        raise ScenarioError(
            f"{name}: no scenario of that name, expected one of {', '.join(names)} "
            f"or a YAML file{_nearest(str(name), names)}"
        )
    try:
        return str(path), path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise ScenarioError(f"{path}: expected YAML text in UTF-8, found other bytes") from None
    except FileNotFoundError:
        hint = _nearest(path.stem, names)
        raise ScenarioError(f"{path}: there is no such file{hint}") from None
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read: {error.strerror}") from None


def _merge(base: Any, top: Any) -> Any:
    """`top` over `base`: maps by key (a changed `kind` starts afresh), the rest replaced."""
    if not (isinstance(base, dict) and isinstance(top, dict)):
        return top
    if "kind" in top and top["kind"] != base.get("kind", top["kind"]):
        return top
    for key, value in top.items():
        base[key] = _merge(base[key], value) if key in base else value
    return base


def _set_path(source: str, tree: dict[str, Any], path: str, value: Any) -> None:
    """Write `value` at a dotted path, making maps on the way; list entries by number."""
    node: Any = tree
    keys = path.split(".")
    for depth, key in enumerate(keys):
        last = depth == len(keys) - 1
        if isinstance(node, list):
            if not key.isdecimal() or int(key) >= len(node):
                raise ScenarioError(
                    f"{source}: {path}: {'.'.join(keys[:depth])} is a list of {len(node)}, "
                    f"expected a number below that instead of {key!r}"
                )
            index: Any = int(key)
        elif isinstance(node, dict):
            index = key
            if not last and not isinstance(node.get(key), (dict, list)):
                node[key] = {}
        else:
            raise ScenarioError(f"{source}: {path}: {'.'.join(keys[:depth])} has no fields")
        if last:
            own = copy.deepcopy(value)  # later paths write into it, and must not into the caller's
            node[index] = _merge(node[index], own) if _has(node, index) else own
        else:
            node = node[index]


def _has(node: Any, index: Any) -> bool:
    return isinstance(node, list) or index in node


def _plain(tree: Any) -> Any:
    """Plain dicts, lists and scalars of what ruamel loaded."""
    if isinstance(tree, dict):
        return {str(key): _plain(value) for key, value in tree.items()}
    if isinstance(tree, list):
        return [_plain(value) for value in tree]
    if isinstance(tree, bool) or tree is None:
        return tree
    for scalar in (int, float, str):
        if isinstance(tree, scalar):
            return scalar(tree)
    return str(tree)


def _sentence(
    error: pydantic.ValidationError, kind: type, tree: Mapping[str, Any], source: str
) -> str:
    """The first complaint of pydantic as one sentence of ours."""
    problems = error.errors(include_url=False)
    # An unknown name explains most of what else is wrong: say that first.
    problem = next((p for p in problems if p["type"] == "unexpected_keyword_argument"), problems[0])
    path, owner = _walk(kind, problem["loc"])
    where = f"{source}{_line(tree, path)}: {'.'.join(path) or 'scenario'}"
    more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
    return f"{where}: {_expectation(problem, path, owner)}{more}"


def _expectation(problem: Any, path: list[str], owner: Any) -> str:
    given, context = problem["input"], problem.get("ctx", {})
    match problem["type"]:
        case "unexpected_keyword_argument":
            names = [field.name for field in fields(owner)] if is_dataclass(owner) else []
            return f"unknown field, expected one of {', '.join(names)}{_nearest(path[-1], names)}"
        case "union_tag_invalid":
            tags = [tag.strip(" '") for tag in context["expected_tags"].split(",")]
            return (
                f"kind {context['tag']!r} is unknown, expected one of {', '.join(tags)}"
                f"{_nearest(str(context['tag']), tags)}"
            )
        case "union_tag_not_found":
            return "expected a map with a field kind"
        case "literal_error":
            choices = [c.strip(" '") for c in context["expected"].replace(" or ", ",").split(",")]
            return f"expected {context['expected']}, found {given!r}{_nearest(str(given), choices)}"
        case "missing" | "missing_argument":
            return "is missing and has no default"
        case "value_error":
            return str(context.get("error", problem["msg"]))
        case _:
            message = problem["msg"].removeprefix("Input should be ").removeprefix("a valid ")
            return f"expected {message}, found {_describe(given)}"


def _describe(value: Any) -> str:
    if isinstance(value, dict):
        return "a map"
    if isinstance(value, list):
        return f"a list of {len(value)}"
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return repr(value)


def _completed(kind: Any, given: Any) -> Any:
    """`given` with every map in it filled up from the default of the field that it is for.

    A field's own default may differ from that of its class: a latency given in part keeps the
    other parts of that sensor's latency. A map of another `kind` starts afresh.
    """
    options = _options(kind)
    if isinstance(given, list):
        inside = next((typing.get_args(o)[0] for o in options if typing.get_args(o)), None)
        return [_completed(inside, value) for value in given]
    owners: list[Any] = [o for o in options if is_dataclass(o)]
    if len(owners) > 1:
        owners = [o for o in owners if isinstance(given, dict) and _tag(o) == given.get("kind")]
    if not isinstance(given, dict) or not owners:
        return given
    hints = typing.get_type_hints(owners[0])
    full = dict(given)
    for name, default in _map_defaults(owners[0]).items():
        if isinstance(full.get(name), dict):
            full[name] = _merge(copy.deepcopy(default), full[name])
    return {name: _completed(hints.get(name), value) for name, value in full.items()}


@functools.cache
def _map_defaults(owner: Any) -> dict[str, Any]:
    """The defaults of a dataclass's fields that are dataclasses themselves, as plain maps."""
    defaults = {}
    for field in fields(owner):
        info = owner.__pydantic_fields__[field.name]
        value = info.get_default(call_default_factory=True)
        if is_dataclass(value):
            defaults[field.name] = to_plain(value)
    return defaults


def _walk(kind: Any, location: Sequence[Any]) -> tuple[list[str], Any]:
    """The dotted path of a pydantic location (union tags left out), and the owning dataclass."""
    path: list[str] = []
    owner: Any = None
    current = kind
    for step in location:
        options = _options(current)
        tagged = [o for o in options if is_dataclass(o) and _tag(o) == step]
        if len(options) > 1 and tagged:
            current = tagged[0]
            continue
        path.append(str(step))
        candidates = [o for o in options if is_dataclass(o)]
        if candidates and isinstance(step, str):
            owner = candidates[0]
            hints = typing.get_type_hints(owner)
            current = hints.get(step)
        else:
            container = next((o for o in options if typing.get_args(o)), None)
            current = typing.get_args(container)[-1] if container else None
    return path, owner


def _options(kind: Any) -> list[Any]:
    """The members of a (possibly annotated, possibly optional) union, else the type itself."""
    origin = typing.get_origin(kind)
    if origin is typing.Annotated:
        return _options(typing.get_args(kind)[0])
    if origin in (typing.Union, types.UnionType):
        return [o for arg in typing.get_args(kind) if arg is not type(None) for o in _options(arg)]
    return [kind]


def _tag(kind: Any) -> Any:
    for field in fields(kind):
        if field.name == "kind":
            return typing.get_args(typing.get_type_hints(kind)["kind"])[0]
    return None


def _line(tree: Any, path: Sequence[str]) -> str:
    """`, line N` of a field in the file, where ruamel knows it."""
    line = None
    node = tree
    for key in path:
        index: Any = int(key) if isinstance(node, list) and key.isdecimal() else key
        try:
            position = node.lc.data.get(index)
            node = node[index]
        except (AttributeError, KeyError, IndexError, TypeError):
            break
        if position:
            line = position[0] + 1
    return f", line {line}" if line else ""


def _nearest(name: str, names: Sequence[str] | Mapping[str, Any]) -> str:
    close = difflib.get_close_matches(name, list(names), n=1, cutoff=0.4)
    return f"; the nearest is {close[0]}" if close else ""


def to_yaml(scenario: Any) -> str:
    """A scenario as the text of a YAML file that loads to the same scenario."""
    stream = io.StringIO()
    yaml = YAML()
    yaml.default_flow_style = False
    yaml.dump(to_plain(scenario), stream)
    return stream.getvalue()
