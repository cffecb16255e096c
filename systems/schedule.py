"""When things happen: one base period times powers of two, and two phases a tick.

Other periods make Drake take extra steps one ulp long, and simultaneous events
all see the values from before the tick. So every block runs in one of two phases
of an 8 ms tick:

| phase | offset | who, in order of cause |
|---|---|---|
| sense and decide | 0 ms | plant, sensors, faults, supervisors, observers |
| estimate and act | 4 ms | delay lines, estimators, controllers |

A gyro sample taken at t is used by the controller at t + 4 ms and moves the
rotors from t + 8 ms. Blocks of one phase see each other one period late.

Why 8 ms: PX4's EKF2 makes a step every 8 to 10 ms, rotors of this size answer in
25 to 60 ms, and an event costs Drake's Python systems about 8 us whatever it does.
The plant integrates with shorter steps of its own inside the tick.
"""

BASE_PERIOD = 0.002  # s
PLANT_PERIOD = 0.008  # s, plant, IMU, EKF2 and controller
ESTIMATE_OFFSET = 0.004  # s, the phase of estimators and controllers
CLOCK_PERIOD = 0.016  # s, grid on which sensors with odd rates look at their clock
SUPERVISOR_PERIOD = 0.032  # s


def on_grid(period: float) -> float:
    """`period` (s) if it is the base period times a power of two; raises `ValueError` otherwise."""
    ratio = period / BASE_PERIOD
    if ratio < 1.0 or ratio != round(ratio) or round(ratio).bit_count() != 1:
        raise ValueError(f"a period of {period} s is not {BASE_PERIOD} s times a power of two")
    return period
