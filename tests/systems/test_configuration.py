"""Configurations: validated on construction and on assignment, unknown fields refused."""

from typing import Literal

import pytest
from pydantic import Field, ValidationError

from systems.configuration import (
    Finite,
    Metres,
    NonNegative,
    Positive,
    Probability,
    Seconds,
    StructureChangedError,
    Vector2,
    Vector3,
    configuration,
    require_same_structure,
)
from systems.schedule import BASE_PERIOD, on_grid


@configuration
class Lamp:
    """A configuration with one field of each kind."""

    kind: Literal["lamp"] = "lamp"
    delay: Seconds = 0.1  # s
    height: Metres = 1.0  # m
    flicker: Probability = 0.0
    noise: NonNegative = 0.0
    power: Positive = 1.0
    offset: Finite = 0.0
    size: Vector2 = Field(default_factory=lambda: [1.0, 2.0])
    position: Vector3 = Field(default_factory=lambda: [0.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("delay", -0.1),
        ("delay", float("nan")),
        ("height", float("inf")),
        ("flicker", 1.01),
        ("flicker", -0.01),
        ("noise", -1e-9),
        ("power", 0.0),
        ("offset", float("inf")),
        ("offset", "high"),
        ("size", [1.0]),
        ("position", [1.0, 2.0, 3.0, 4.0]),
        ("position", [1.0, 2.0, float("nan")]),
        ("kind", "candle"),
    ],
)
def test_refuses_impossible_values(field, value):
    with pytest.raises(ValidationError, match=field):
        Lamp(**{field: value})
    lamp = Lamp()
    with pytest.raises(ValidationError):
        setattr(lamp, field, value)


@pytest.mark.parametrize(
    ("field", "value"), [("delay", 0.0), ("flicker", 0.0), ("flicker", 1.0), ("offset", -3.0)]
)
def test_accepts_the_limits(field, value):
    assert getattr(Lamp(**{field: value}), field) == value


def test_refuses_unknown_fields_and_positions():
    with pytest.raises(ValidationError, match="brightness"):
        Lamp(brightness=3.0)
    with pytest.raises((TypeError, ValidationError)):
        Lamp("lamp")


def test_defaults_are_not_shared():
    Lamp().position.append(9.0)
    assert Lamp().position == [0.0, 0.0, 0.0]


def test_equal_by_value():
    assert Lamp(delay=0.2) == Lamp(delay=0.2) != Lamp()


def test_require_same_structure():
    require_same_structure(Lamp(power=1.0), Lamp(power=2.0), "delay", "size")
    with pytest.raises(StructureChangedError, match=r"Lamp\.delay .* \(0\.1\) .* 0\.2"):
        require_same_structure(Lamp(), Lamp(delay=0.2), "height", "delay")
    assert issubclass(StructureChangedError, ValueError)


@pytest.mark.parametrize("exponent", range(10))
def test_powers_of_two_are_on_the_grid(exponent):
    period = round(BASE_PERIOD * 2**exponent, 4)
    assert on_grid(period) == period


@pytest.mark.parametrize("period", [0.0, 0.001, 0.003, 0.006, 0.1, 1.0 / 30.0, -0.0025])
def test_other_periods_are_not(period):
    with pytest.raises(ValueError, match="power of two"):
        on_grid(period)
