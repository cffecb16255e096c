"""Inputs for the tests of landing-target estimators: a vehicle that flies, and what it measures."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiagramBuilder,
    DiscreteValues,
    EventStatus,
    LeafSystem,
    System,
)
from pydrake.systems.primitives import LogVectorOutput

from systems.signals.measurement import (
    INFRARED,
    MARKER,
    TARGET_ESTIMATE,
    TARGET_MEASUREMENT,
    VEHICLE_ESTIMATE,
    no_measurement,
)

PERIOD = 0.02  # s, of the estimators' events


@dataclass
class Sway:
    """A vehicle that sways horizontally while it descends: p(t) = A sin(2πft), z = z0 − s t."""

    amplitude: tuple[float, float] = (0.8, -0.5)  # m
    frequency: float = 0.2  # 1/s
    height: float = 8.0  # m
    descent: float = 0.3  # m/s

    def position(self, t: float) -> np.ndarray:
        """p_WB, m."""
        x, y = np.array(self.amplitude) * np.sin(2 * np.pi * self.frequency * t)
        return np.array([x, y, self.height - self.descent * t])

    def velocity(self, t: float) -> np.ndarray:
        """v_WB, m/s."""
        w = 2 * np.pi * self.frequency
        x, y = np.array(self.amplitude) * w * np.cos(w * t)
        return np.array([x, y, -self.descent])

    def acceleration(self, t: float) -> np.ndarray:
        """a_WB, m/s2."""
        w = 2 * np.pi * self.frequency
        x, y = -np.array(self.amplitude) * w**2 * np.sin(w * t)
        return np.array([x, y, 0.0])

    def estimate(self, t: float) -> np.ndarray:
        """A VEHICLE_ESTIMATE without errors."""
        estimate = VEHICLE_ESTIMATE.zeros()
        estimate[:4] = t, 1.0, 1.0, 1.0
        estimate[VEHICLE_ESTIMATE.index("q_WB_w")] = 1.0
        estimate[VEHICLE_ESTIMATE.slice("p_WB")] = self.position(t)
        estimate[VEHICLE_ESTIMATE.slice("v_WB")] = self.velocity(t)
        estimate[VEHICLE_ESTIMATE.slice("a_WB")] = self.acceleration(t)
        return estimate


def target_measurement(
    p_BP_W: np.ndarray, validity: float, arrival: float, variance: float = 0.01
) -> np.ndarray:
    """A valid TARGET_MEASUREMENT."""
    measurement = TARGET_MEASUREMENT.zeros()
    measurement[:4] = validity, arrival, round(arrival / PERIOD), 1.0
    measurement[TARGET_MEASUREMENT.slice("p_BP_W")] = p_BP_W
    for field in ("xx", "yy", "zz"):
        measurement[TARGET_MEASUREMENT.index(f"covariance_{field}")] = variance
    measurement[TARGET_MEASUREMENT.index("source")] = 2.0
    return measurement


class Bench:
    """Runs one estimator event by event with inputs given by hand."""

    def __init__(self, system: LeafSystem):
        """A bench for a system with one periodic update."""
        self.system = system
        self.context = system.CreateDefaultContext()

    def step(self, k: int, **inputs: np.ndarray) -> Any:
        """Event number k with these inputs; the first output as a flat array."""
        self.context.SetTime(k * PERIOD)
        for name, value in inputs.items():
            self.system.GetInputPort(name).FixValue(self.context, value)
        update = self.system.EvalUniquePeriodicDiscreteUpdate(self.context)
        self.context.get_mutable_discrete_state().SetFrom(update)
        return self.system.get_output_port(0).Eval(self.context).copy()


def fly(
    system: LeafSystem,
    sway: Sway,
    duration: float,
    noise: float = 0.0,
    latency: int = 0,
    every: int = 2,
    visible: Any = lambda t: True,
    seed: int = 1,
) -> tuple[np.ndarray, np.ndarray]:
    """Feed a filter with late, noisy positions of a pad at the origin.

    Returns the times (n,) and the TARGET_ESTIMATEs (n, size).
    """
    rng = np.random.default_rng(seed)
    bench = Bench(system)
    measurement = TARGET_MEASUREMENT.zeros()
    measurement[:3] = -1.0
    times, targets = [], []
    for k in range(round(duration / PERIOD)):
        t = k * PERIOD
        if k % every == 0 and k >= latency and visible(t):
            then = t - latency * PERIOD
            p = -sway.position(then) + noise * rng.standard_normal(3)
            measurement = target_measurement(p, then, t, max(noise, 0.01) ** 2)
        times.append(t)
        targets.append(bench.step(k, measurement=measurement, estimate=sway.estimate(t)))
    return np.array(times), np.array(targets)


def field(targets: np.ndarray, name: str) -> np.ndarray:
    """One field of many TARGET_ESTIMATEs, shape (n,)."""
    return targets[:, TARGET_ESTIMATE.index(name)]


def horizontal_error(times: np.ndarray, targets: np.ndarray, sway: Sway) -> np.ndarray:
    """Estimated minus true p_BP_W, horizontally, shape (n, 2)."""
    truth = np.array([-sway.position(t)[:2] for t in times])
    first = TARGET_ESTIMATE.index("p_BP_W_x")
    return targets[:, first : first + 2] - truth


def port_names(system: System) -> tuple[list[str], list[str]]:
    """Names of the input and output ports."""
    return (
        [system.get_input_port(i).get_name() for i in range(system.num_input_ports())],
        [system.get_output_port(i).get_name() for i in range(system.num_output_ports())],
    )


class Scene(LeafSystem):
    """Marker and infrared measurements 40 ms late, every 40 ms, of a pad at W's origin.

    The vehicle sways without tilting; both cameras sit at the body's origin, looking down.
    """

    def __init__(self, sway: Sway, marker_until: float, infrared_until: float):
        """Each sensor falls silent at its time (s)."""
        super().__init__()
        self.sway, self.until = sway, {"marker": marker_until, "infrared": infrared_until}
        everything = {self.time_ticket()}
        size = VEHICLE_ESTIMATE.size
        self.DeclareVectorOutputPort("estimate", size, self._estimate, everything)
        for name, layout in (("marker", MARKER), ("infrared", INFRARED)):
            state = self.DeclareDiscreteState(BasicVector(no_measurement(layout)))
            self.DeclareStateOutputPort(name, state)
        self.DeclarePeriodicDiscreteUpdateEvent(2 * PERIOD, 0.0, self._update)

    def _estimate(self, context: Context, output: BasicVector) -> None:
        estimate = self.sway.estimate(context.get_time())
        estimate[VEHICLE_ESTIMATE.index("height_above_ground")] = self.sway.position(
            context.get_time()
        )[2]
        estimate[VEHICLE_ESTIMATE.index("height_above_ground_valid")] = 1.0
        output.SetFromVector(estimate)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        t = context.get_time()
        x, y, z = -self.sway.position(t - 2 * PERIOD)
        p_CP = np.array([-y, -x, -z])  # x_C = −y_B, y_C = −x_B, z_C = −z_B
        marker, infrared = (discrete_state.get_mutable_value(i) for i in range(2))
        for name, values in (("marker", marker), ("infrared", infrared)):
            values[:4] = t - 2 * PERIOD, t, round(t / (2 * PERIOD)), t < self.until[name]
        marker[MARKER.slice("bearing_C")] = p_CP / np.linalg.norm(p_CP)
        marker[MARKER.index("range")] = np.linalg.norm(p_CP)
        infrared[INFRARED.index("count")] = 1.0
        infrared[INFRARED.index("blob_0_x")] = p_CP[0] / p_CP[2]
        infrared[INFRARED.index("blob_0_y")] = p_CP[1] / p_CP[2]
        return EventStatus.Succeeded()


def simulate(config: Any, scene: Scene, duration: float) -> tuple[np.ndarray, np.ndarray]:
    """Run an estimator's diagram on a scene: times (n,) and TARGET_ESTIMATEs (n, size)."""
    builder = DiagramBuilder()
    builder.AddNamedSystem("scene", scene)
    estimator = config.add_to(builder, "target_estimator", seed=1)
    for name in ("marker", "infrared", "estimate"):
        builder.Connect(scene.GetOutputPort(name), estimator.GetInputPort(name))
    log = LogVectorOutput(estimator.GetOutputPort("target"), builder, PERIOD)
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(duration)
    found = log.FindLog(simulator.get_context())
    return found.sample_times().copy(), found.data().T.copy()
