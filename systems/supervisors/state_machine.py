"""A state machine whose transition table is data: it can be read, drawn, checked and run.

A table names states, the actions to do on entering and while staying in each, and
the transitions between them with their guards. Guards and actions are names of
methods of the objects the table is bound to; each takes one argument, the situation::

    TransitionTable(
        initial="descend",
        states=(State("descend", stay=("follow_target",)), State("hold", entry=("stop",))),
        transitions=(Transition("descend", "hold", guard="target_lost"), ...),
    )

The order of a state's transitions is their priority. One event of the machine is:

    1. the guards of the present state's transitions are asked in order; the first
       that holds fires: its actions, then the entry actions of the new state
    2. the stay actions of the (new) state

so at most one transition fires an event.
"""

import inspect
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import pydot


@dataclass(frozen=True)
class State:
    """A state of a table.

    Attributes
    ----------
    name : str
        Unique within the table.
    entry, stay : tuple of str
        The actions on entering, and those of every event in the state, in order.
    final : bool
        Whether the machine may stay for ever; such a state has no way out.
    """

    name: str
    entry: tuple[str, ...] = ()
    stay: tuple[str, ...] = ()
    final: bool = False


@dataclass(frozen=True)
class Transition:
    """One way out of a state: `source` to `target` when `guard` holds, doing `actions`."""

    source: str
    target: str
    guard: str
    actions: tuple[str, ...] = ()


@dataclass(frozen=True)
class TransitionTable:
    """States and transitions; validated by `problems`, not on construction.

    Attributes
    ----------
    initial : str
        The state the machine starts in.
    states : tuple of State
    transitions : tuple of Transition
        In order of priority within each source state.
    """

    initial: str
    states: tuple[State, ...]
    transitions: tuple[Transition, ...]

    def index(self, name: str) -> int:
        """The index of a state; raises `KeyError` with the known names if there is none."""
        for i, state in enumerate(self.states):
            if state.name == name:
                return i
        known = ", ".join(state.name for state in self.states)
        raise KeyError(f"no state {name!r}; there are {known}")

    def ways_out(self, name: str) -> list[Transition]:
        """The transitions out of a state, in order of priority."""
        return [transition for transition in self.transitions if transition.source == name]

    def joined(self, other: "TransitionTable", *bridges: Transition) -> "TransitionTable":
        """The table followed by `other`, connected by the transitions `bridges`."""
        return TransitionTable(
            initial=self.initial,
            states=self.states + other.states,
            transitions=self.transitions + bridges + other.transitions,
        )


def transitions_from(
    sources: tuple[str, ...], target: str, guard: str, actions: tuple[str, ...] = ()
) -> tuple[Transition, ...]:
    """The same transition out of several states."""
    return tuple(Transition(source, target, guard, actions) for source in sources)


def reachable_states(table: TransitionTable) -> set[str]:
    """The names of the states that some sequence of transitions reaches."""
    reached: set[str] = set()
    frontier = [table.initial]
    while frontier:
        name = frontier.pop()
        if name not in reached:
            reached.add(name)
            frontier.extend(transition.target for transition in table.ways_out(name))
    return reached


def problems(table: TransitionTable) -> list[str]:
    """What is wrong with a table, one sentence each; empty if it is sound.

    Sound: names are unique and known, every state is reachable, a final state is
    reachable from every state, and exactly the final states have no way out.
    """

    def find() -> Iterator[str]:
        names = [state.name for state in table.states]
        for name in sorted({name for name in names if names.count(name) > 1}):
            yield f"state {name} is there twice"
        mentioned = {table.initial}
        for transition in table.transitions:
            mentioned |= {transition.source, transition.target}
        unknown = mentioned.difference(names)
        for name in sorted(unknown):
            yield f"state {name} is not declared"
        if unknown:
            return
        reached = reachable_states(table)
        final = {state.name for state in table.states if state.final}
        for state in table.states:
            if state.name not in reached:
                yield f"state {state.name} cannot be reached"
            if state.final and table.ways_out(state.name):
                yield f"state {state.name} is final and has a way out"
            from_here = TransitionTable(state.name, table.states, table.transitions)
            if not reachable_states(from_here) & final:
                yield f"no final state can be reached from {state.name}"

    return list(find())


def to_dot(table: TransitionTable, name: str, *handlers: object) -> str:
    """The table as Graphviz DOT text.

    Parameters
    ----------
    table : TransitionTable
    name : str
        The name of the graph.
    *handlers : object
        The objects (or classes) with the guards; where given, the first line of a
        guard's docstring stands on its edge instead of its name.
    """
    graph = pydot.Dot(name, graph_type="digraph", rankdir="TB")
    graph.add_node(pydot.Node("initial", shape="point"))
    for state in table.states:
        rows = [state.name]
        rows += [f"entry / {action}" for action in state.entry]
        rows += [f"stay / {action}" for action in state.stay]
        graph.add_node(
            pydot.Node(
                state.name,
                label=_quoted(r"\n".join(rows)),
                shape="box",
                style="rounded",
                peripheries="2" if state.final else "1",
            )
        )
    graph.add_edge(pydot.Edge("initial", table.initial))
    for state in table.states:
        ways = table.ways_out(state.name)
        for priority, transition in enumerate(ways, start=1):
            text = _explanation(transition.guard, handlers)
            label = f"{priority}. {text}" if len(ways) > 1 else text
            label += "".join(rf"\n/ {action}" for action in transition.actions)
            graph.add_edge(pydot.Edge(transition.source, transition.target, label=_quoted(label)))
    return str(graph.to_string())


def _quoted(text: str) -> str:
    return '"' + text.replace('"', r"\"") + '"'


def _explanation(guard: str, handlers: tuple[object, ...]) -> str:
    for handler in handlers:
        method = getattr(handler, guard, None)
        if method is not None:
            return (inspect.getdoc(method) or guard).splitlines()[0].rstrip(".")
    return guard


Guard = Callable[[Any], bool]
Action = Callable[[Any], None]


class StateMachine:
    """A table bound to the objects that have its guards and actions. It holds no run state."""

    def __init__(self, table: TransitionTable, *handlers: object):
        """Look every guard and action up in `handlers`, the first that has it.

        Raises
        ------
        ValueError
            If the table is unsound.
        AttributeError
            If no handler has a guard or an action.
        """
        found = problems(table)
        if found:
            raise ValueError("; ".join(found))
        self.table = table

        def method(name: str) -> Callable[[Any], Any]:
            for handler in handlers:
                candidate = getattr(handler, name, None)
                if candidate is not None:
                    return candidate
            owners = ", ".join(type(handler).__name__ for handler in handlers)
            raise AttributeError(f"no guard or action {name!r} in {owners}")

        def methods(names: tuple[str, ...]) -> tuple[Action, ...]:
            return tuple(method(name) for name in names)

        self._entry = [methods(state.entry) for state in table.states]
        self._stay = [methods(state.stay) for state in table.states]
        self._ways: list[tuple[tuple[Guard, int, tuple[Action, ...]], ...]] = [
            tuple(
                (method(way.guard), table.index(way.target), methods(way.actions))
                for way in table.ways_out(state.name)
            )
            for state in table.states
        ]

    def next_state(self, state: int, situation: Any) -> int:
        """The state after the first transition whose guard holds, its actions and entry done."""
        for guard, target, actions in self._ways[state]:
            if guard(situation):
                for action in actions:
                    action(situation)
                for action in self._entry[target]:
                    action(situation)
                return target
        return state

    def stay(self, state: int, situation: Any) -> None:
        """Do the stay actions of a state."""
        for action in self._stay[state]:
            action(situation)
