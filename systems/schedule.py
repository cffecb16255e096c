"""When things happen: one base period times powers of two, every block on the same tick.

Other periods make Drake take extra steps one ulp long, and every step costs Drake about
25 us whatever happens in it. So there is one tick, of 10 ms, and all blocks have their
events on it or on a multiple of it.

All discrete updates of one instant see the values from before it: every hop from block to
block takes a tick. A gyro sample of time t is used by the controller at t + 10 ms and
moves the rotors from t + 20 ms on. An autopilot's rate loop is three times as fast; the
gains of ours are chosen for its own delay (`MultirotorCascadeConfig.gains`), and what is
studied here, landings on late and wrong measurements, happens in tenths of seconds.

Why 10 ms: PX4's EKF2 makes its step every 10 ms (EKF2_PREDICT_US), rotors of this size
answer in 25 to 60 ms, and an event costs Drake's Python systems about 12 us whatever it
does. The plant integrates with shorter steps of its own inside the tick.
"""

BASE_PERIOD = 0.0025  # s
PLANT_PERIOD = 0.01  # s, plant, IMU, EKF2 and controller
CLOCK_PERIOD = 0.02  # s, grid on which sensors with odd rates look at their clock
SUPERVISOR_PERIOD = 0.04  # s


def on_grid(period: float) -> float:
    """`period` (s) if it is the base period times a power of two; raises `ValueError` otherwise."""
    ratio = period / BASE_PERIOD
    if ratio < 1.0 or ratio != round(ratio) or round(ratio).bit_count() != 1:
        raise ValueError(f"a period of {period} s is not {BASE_PERIOD} s times a power of two")
    return period
