"""Benches for the systems of the fixed wing: constant inputs, one log."""

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput

from systems.signals import runway_measurement
from systems.signals.measurement import TIME_OF_ARRIVAL, Layout
from tests.system_contract import assert_matches_docstring


def assert_contract(system) -> None:
    """The ports are those of the docstring, and of the size of the layouts it names."""
    contract = assert_matches_docstring(system)
    for name, layout_name in contract.layouts.items():
        layout = getattr(runway_measurement, layout_name, None)
        if isinstance(layout, Layout):
            inputs = name in contract.inputs
            port = system.GetInputPort(name) if inputs else system.GetOutputPort(name)
            assert port.size() == layout.size, f"port {name} is not a {layout_name}"


def log_of(system, inputs: dict[str, np.ndarray], duration: float, period: float = 0.01):
    """Every sample of the first output: times, shape (n,), and values, shape (n, size)."""
    builder = DiagramBuilder()
    builder.AddSystem(system)
    for name, value in inputs.items():
        source = builder.AddSystem(ConstantVectorSource(value))
        builder.Connect(source.get_output_port(), system.GetInputPort(name))
    log = LogVectorOutput(system.get_output_port(0), builder, period)
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(duration)
    found = log.FindLog(simulator.get_context())
    return found.sample_times().copy(), found.data().T.copy()


def arrivals(system, inputs: dict[str, np.ndarray], duration: float) -> np.ndarray:
    """One row a measurement that arrived, shape (n, size)."""
    _, values = log_of(system, inputs, duration)
    values = values[values[:, TIME_OF_ARRIVAL] >= 0.0]
    first = np.unique(values[:, TIME_OF_ARRIVAL], return_index=True)[1]
    return values[first]
