"""Optional input ports: connected, unconnected, and an error behind a connected one."""

import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource

from systems.signals.optional_input import optional_input

OTHERWISE = np.array([7.0, 8.0])


class Reader(LeafSystem):
    def __init__(self):
        super().__init__()
        self.value = optional_input(self.DeclareVectorInputPort("optional", 2), OTHERWISE)


class Broken(LeafSystem):
    def __init__(self):
        super().__init__()
        self.DeclareVectorOutputPort("output", 2, self._calc)

    def _calc(self, context, output):
        raise RuntimeError("broken upstream")


def read_from(source: LeafSystem) -> np.ndarray:
    builder = DiagramBuilder()
    reader = builder.AddSystem(Reader())
    builder.AddSystem(source)
    builder.Connect(source.get_output_port(), reader.get_input_port())
    context = builder.Build().CreateDefaultContext()
    return reader.value(reader.GetMyContextFromRoot(context))


def test_unconnected_it_is_the_default():
    reader = Reader()
    assert reader.value(reader.CreateDefaultContext()) is OTHERWISE


def test_fixed_or_connected_it_is_the_port():
    reader = Reader()
    context = reader.CreateDefaultContext()
    reader.get_input_port().FixValue(context, [1.0, 2.0])
    np.testing.assert_array_equal(reader.value(context), [1.0, 2.0])
    np.testing.assert_array_equal(read_from(ConstantVectorSource([3.0, 4.0])), [3.0, 4.0])


def test_an_error_behind_a_connected_port_is_not_swallowed():
    with pytest.raises(RuntimeError, match="broken upstream"):
        read_from(Broken())


def test_a_port_that_was_unconnected_may_be_fixed_and_cleared():
    reader = Reader()
    bare, fixed = reader.CreateDefaultContext(), reader.CreateDefaultContext()
    reader.get_input_port().FixValue(fixed, [1.0, 2.0])
    for _ in range(2):
        assert reader.value(bare) is OTHERWISE
        np.testing.assert_array_equal(reader.value(fixed), [1.0, 2.0])
