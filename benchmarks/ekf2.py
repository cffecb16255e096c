"""What a step of the navigation filter costs: the kernels alone, and the block in Drake."""

import time
from collections.abc import Callable

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import AffineSystem

from runs.replay import play
from runs.simulated_log import Rates, simulated_log
from systems.estimators.ekf2 import filter as kernels
from systems.estimators.ekf2 import parameters as prm
from systems.estimators.ekf2.ekf2 import Ekf2Config
from systems.schedule import PLANT_PERIOD
from systems.sensors.barometer import BAROMETER_PERIOD
from systems.sensors.magnetometer import MAGNETOMETER_PERIOD
from systems.signals.measurement import BAROMETER, GNSS, INERTIAL, MAGNETOMETER

SECONDS = 60.0  # s simulated
PLACE = (39.3648, 22.9470, 30.0)  # deg, deg, m
FIELD_B = (0.2581, -0.0233, -0.3910)  # gauss, B, nose to the north
GRAVITY = 9.80  # m/s2
GNSS_PERIOD = 0.16  # s, nearly 5 Hz, on the grid
REPEATS = 3  # the best counts


def _best(run: Callable[[], float]) -> float:
    return min(run() for _ in range(REPEATS))


def kernel_step_cost(imu_rate: float = 250.0) -> float:
    """CPU microseconds a filter step, fed by plain calls: IMU, barometer, magnetometer, GNSS."""
    p = prm.parameter_array({}, earth_field=(5.2, 56.5, 0.469))
    dt = 1.0 / imu_rate
    imu = np.array([0, 0, 0, 0, 0, 0, -GRAVITY * dt, dt, dt, 0, 0, 0.0])
    barometer = np.array([0, PLACE[2], 0.0])
    magnetometer = np.array([0, FIELD_B[0], -FIELD_B[1], -FIELD_B[2], 0.0])
    gnss = np.array([0, *PLACE, 0, 0, 0, 0.5, 0.8, 0.2, 3, 14, 1.1, 0, 0])
    status = np.array([0, 1, 0, 0, 0, 0.0])
    sources = (
        (kernels.push_barometer, barometer, 32_000),
        (kernels.push_magnetometer, magnetometer, 32_000),
        (kernels.push_gnss, gnss, 200_000),
        (kernels.push_status, status, 500_000),
    )

    def run() -> float:
        x = kernels.initialise(p)
        steps = 0
        begin = time.process_time()
        for k in range(1, round(SECONDS * imu_rate) + 1):
            now = round(k * 1e6 / imu_rate)
            imu[0] = now
            kernels.push_imu(x, p, imu)
            for push, row, period in sources:
                if now % period == 0:
                    row[0] = now
                    push(x, p, row)
            steps += kernels.update(x, p)
        return (time.process_time() - begin) / steps * 1e6

    run()
    return _best(run)


def _sensor(period: float, fields: tuple[float, ...]) -> AffineSystem:
    """A sensor in C++: messages of constant content, new every `period` (s)."""
    size = 4 + len(fields)
    step = np.zeros(size)
    step[:3] = period, period, 1.0
    nothing = np.zeros((size, 0))
    system = AffineSystem(
        A=np.eye(size), B=nothing, f0=step, C=np.eye(size), D=nothing, y0=np.zeros(size),
        time_period=period,
    )  # fmt: skip
    system.configure_default_state([0.0, 0.0, 0.0, 1.0, *fields])
    return system


def drake_step_cost(with_filter: bool = True) -> float:
    """CPU microseconds a filter step of a diagram with sensors and, or not, an `Ekf2` block."""
    builder = DiagramBuilder()
    ekf2 = Ekf2Config(origin=list(PLACE)).add_to(builder, "ekf2") if with_filter else None
    dt = PLANT_PERIOD
    sources = {
        "imu": (INERTIAL, dt, (0, 0, 0, 0, 0, GRAVITY * dt, dt, dt, 0)),
        "barometer": (BAROMETER, BAROMETER_PERIOD, PLACE[2:]),
        "magnetometer": (MAGNETOMETER, MAGNETOMETER_PERIOD, FIELD_B),
        "gnss": (GNSS, GNSS_PERIOD, (*PLACE, 0, 0, 0, 0.5, 0.8, 0.2, 3, 14, 1.1)),
    }
    for name, (layout, period, fields) in sources.items():
        source = builder.AddSystem(_sensor(period, fields))
        assert source.get_output_port().size() == layout.size
        if ekf2 is not None:
            builder.Connect(source.get_output_port(), ekf2.GetInputPort(name))
    diagram = builder.Build()
    simulator = Simulator(diagram)

    def run() -> float:
        context = simulator.get_mutable_context()
        context.SetTime(0.0)
        diagram.SetDefaultContext(context)
        simulator.Initialize()
        simulator.AdvanceTo(1.0)
        begin = time.process_time()
        simulator.AdvanceTo(SECONDS)
        return (time.process_time() - begin) / ((SECONDS - 1.0) / PLANT_PERIOD) * 1e6

    run()
    return _best(run)


def replay_cost() -> float:
    """CPU seconds of the replay of a stream of `SECONDS`, after start-up."""
    samples, _ = simulated_log(seed=0, seconds=SECONDS, rates=Rates(vision=10.0))
    p = prm.parameter_array({"EKF2_DELAY_MAX": 300, "EKF2_EV_CTRL": 3, "EKF2_EV_DELAY": 200})

    def run() -> float:
        begin = time.process_time()
        play(samples, p)
        return time.process_time() - begin

    run()
    return _best(run)


def main() -> None:
    """Print the table."""
    block = drake_step_cost() - drake_step_cost(with_filter=False)
    print(f"EKF2 kernels, 250 Hz IMU:   {kernel_step_cost():6.1f} us CPU a filter step")
    print(f"EKF2 block in Drake:        {block:6.1f} us CPU a filter step")
    print(f"EKF2 replay of {SECONDS:.0f} s:        {1e3 * replay_cost():6.1f} ms CPU")


if __name__ == "__main__":
    main()
