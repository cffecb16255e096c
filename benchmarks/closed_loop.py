"""Simulated seconds per CPU second of the whole closed loop, beside a bare C++ plant."""

import time

import numpy as np
from pydrake.examples import QuadrotorPlant, StabilizingLQRController
from pydrake.systems.analysis import ResetIntegratorFromFlags, Simulator
from pydrake.systems.framework import DiagramBuilder

from diagrams.loading import load_scenario
from runs.run import Laboratory

SCENARIO = "infrared-and-marker"
BARE_SECONDS = 120.0  # s simulated; long enough that start-up does not show
REPEATS = 3  # interleaved; medians are printed


def closed_loop_rate(laboratory: Laboratory) -> float:
    """Simulated seconds per CPU second of one flight of a built laboratory."""
    result = laboratory.fly()
    return result.simulated_s / result.cpu_s


def bare_plant() -> Simulator:
    """Drake's own C++ `QuadrotorPlant` under LQR: no sensors, no estimator, no supervisor."""
    builder = DiagramBuilder()
    plant = builder.AddSystem(QuadrotorPlant())
    controller = builder.AddSystem(StabilizingLQRController(plant, np.array([0.0, 0.0, 1.0])))
    builder.Connect(controller.get_output_port(0), plant.get_input_port(0))
    builder.Connect(plant.get_output_port(0), controller.get_input_port(0))
    simulator = Simulator(builder.Build())
    ResetIntegratorFromFlags(simulator, "runge_kutta2", 0.001)
    return simulator


def bare_plant_rate(simulator: Simulator) -> float:
    """Simulated seconds per CPU second of the bare plant from a disturbed start."""
    context = simulator.get_mutable_context()
    context.SetTime(0.0)
    context.SetContinuousState(np.full(12, 0.05))
    simulator.Initialize()
    begin = time.process_time()
    simulator.AdvanceTo(BARE_SECONDS)
    return BARE_SECONDS / (time.process_time() - begin)


def main() -> None:
    """Print the table."""
    laboratories = {
        fidelity: Laboratory(load_scenario(SCENARIO, {"fidelity": fidelity}))
        for fidelity in ("geometric", "pixels")
    }
    bare = bare_plant()
    closed_loop_rate(laboratories["geometric"])  # compile first
    rates: dict[str, list[float]] = {"geometric": [], "pixels": [], "bare": []}
    for _ in range(REPEATS):
        rates["bare"].append(bare_plant_rate(bare))
        for fidelity, laboratory in laboratories.items():
            rates[fidelity].append(closed_loop_rate(laboratory))
    median = {name: float(np.median(values)) for name, values in rates.items()}
    print("Simulated seconds per CPU second (median of", REPEATS, "interleaved flights)")
    for name, label in (
        ("geometric", "whole closed loop, geometric cameras"),
        ("pixels", "whole closed loop, pixels"),
        ("bare", "bare C++ QuadrotorPlant + LQR, RK2 1 ms"),
    ):
        ratio = median["bare"] / median[name]
        print(f"  {label:42} {median[name]:8.1f}   1/{ratio:.1f} of the bare plant")
