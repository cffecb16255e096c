"""A camera over a pad, with nothing else: what the tests of the cameras share."""

from collections.abc import Callable
from typing import Any

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from systems.schedule import CLOCK_PERIOD
from systems.sensors.pad_camera import PadCamera
from systems.signals.measurement import BODY_STATE, TIME_OF_ARRIVAL

FIDELITIES = ("geometric", "pixels")


def body(p_WB=(0.2, 0.1, 4.0), v_WB=(0.0, 0.0, 0.0)) -> np.ndarray:
    """A level BODY_STATE."""
    state = BODY_STATE.zeros()
    state[0] = 1.0
    state[BODY_STATE.slice("p_WB")] = p_WB
    state[BODY_STATE.slice("v_WB")] = v_WB
    return state


def simulated(camera: PadCamera, **inputs: np.ndarray) -> tuple[Simulator, Callable[[str], Any]]:
    """A simulator of a camera with constant inputs, and a function that reads its ports."""
    builder = DiagramBuilder()
    builder.AddNamedSystem("camera", camera)
    for port, value in inputs.items():
        source = builder.AddSystem(ConstantVectorSource(value))
        builder.Connect(source.get_output_port(), camera.GetInputPort(port))
    simulator = Simulator(builder.Build())

    def read(port: str) -> Any:
        context = camera.GetMyContextFromRoot(simulator.get_context())
        return camera.GetOutputPort(port).Eval(context)

    return simulator, read


def measurements(camera: PadCamera, state: np.ndarray, duration: float) -> np.ndarray:
    """Each measurement of a run over `duration` (s), shape (n, size)."""
    simulator, read = simulated(camera, body=state)
    rows = []
    for tick in range(round(duration / CLOCK_PERIOD)):
        simulator.AdvanceTo((tick + 0.5) * CLOCK_PERIOD)
        rows.append(np.array(read("measurement")))
    table = np.array(rows)
    return table[np.flatnonzero(np.diff(table[:, TIME_OF_ARRIVAL], prepend=-1.0))]
