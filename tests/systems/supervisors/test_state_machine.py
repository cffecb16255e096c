"""Transition tables as data: what makes one sound, how it is drawn, how it runs."""

import pydot
import pytest

from systems.supervisors.state_machine import (
    State,
    StateMachine,
    Transition,
    TransitionTable,
    problems,
    reachable_states,
    to_dot,
    transitions_from,
)

DOOR = TransitionTable(
    initial="closed",
    states=(
        State("closed", stay=("count",)),
        State("open", entry=("ring",), stay=("count",)),
        State("broken", final=True),
    ),
    transitions=(
        Transition("closed", "open", "pushed", ("creak",)),
        Transition("open", "closed", "pushed"),
        *transitions_from(("closed", "open"), "broken", "kicked"),
    ),
)


class Handlers:
    """Guards and actions that write down what they did."""

    def pushed(self, situation):
        """Somebody pushes."""
        return "push" in situation["events"]

    def kicked(self, situation):
        return "kick" in situation["events"]

    def creak(self, situation):
        situation["done"].append("creak")

    def ring(self, situation):
        situation["done"].append("ring")

    def count(self, situation):
        situation["done"].append("count")


def changed(**fields) -> TransitionTable:
    return TransitionTable(
        **{
            "initial": DOOR.initial,
            "states": DOOR.states,
            "transitions": DOOR.transitions,
            **fields,
        }
    )


def test_sound_table_has_no_problems():
    assert problems(DOOR) == []
    assert reachable_states(DOOR) == {"closed", "open", "broken"}


@pytest.mark.parametrize(
    ("table", "problem"),
    [
        (changed(states=(*DOOR.states, State("lost"))), "state lost cannot be reached"),
        (changed(states=(*DOOR.states, State("open"))), "state open is there twice"),
        (changed(initial="ajar"), "state ajar is not declared"),
        (
            changed(transitions=(*DOOR.transitions, Transition("broken", "open", "pushed"))),
            "state broken is final and has a way out",
        ),
        (
            changed(transitions=(Transition("closed", "open", "pushed"),)),
            "no final state can be reached from closed",
        ),
    ],
)
def test_problems_are_found(table, problem):
    assert problem in problems(table)
    with pytest.raises(ValueError, match=problem):
        StateMachine(table, Handlers())


def test_unknown_handler_is_named():
    class Deaf:
        pushed = Handlers.pushed

    with pytest.raises(AttributeError, match=r"no guard or action '\w+' in Deaf"):
        StateMachine(DOOR, Deaf())


def test_transition_does_its_actions_then_the_entry():
    machine = StateMachine(DOOR, Handlers())
    situation = {"events": ["push"], "done": []}
    state = machine.next_state(0, situation)
    machine.stay(state, situation)
    assert DOOR.states[state].name == "open"
    assert situation["done"] == ["creak", "ring", "count"]


def test_first_transition_in_the_table_has_priority():
    machine = StateMachine(DOOR, Handlers())
    state = machine.next_state(0, {"events": ["push", "kick"], "done": []})
    assert DOOR.states[state].name == "open"


def test_state_stays_without_a_guard():
    machine = StateMachine(DOOR, Handlers())
    assert machine.next_state(1, {"events": [], "done": []}) == 1


def test_unknown_state_name_lists_the_known_ones():
    with pytest.raises(KeyError, match="closed, open, broken"):
        DOOR.index("ajar")


def test_drawing_has_every_state_and_transition():
    text = to_dot(DOOR, "door", Handlers())
    (graph,) = pydot.graph_from_dot_data(text)
    assert {node.get_name() for node in graph.get_nodes()} == {
        "initial",
        "closed",
        "open",
        "broken",
    }
    edges = {(edge.get_source(), edge.get_destination()) for edge in graph.get_edges()}
    assert edges == {("initial", "closed")} | {(t.source, t.target) for t in DOOR.transitions}
    assert "1. Somebody pushes" in text
    assert "2. kicked" in text
