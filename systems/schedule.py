"""When things happen: one base period times powers of two, and two phases a tick.

Other periods make Drake take extra steps one ulp long, and simultaneous events
all see the values from before the tick. So every block runs in one of two phases
of a 4 ms tick:

| phase | offset | who, in order of cause |
|---|---|---|
| sense and decide | 0 ms | plant, sensors, faults, supervisors, observers |
| estimate and act | 2 ms | delay lines, estimators, controllers |

A gyro sample taken at t is used by the controller at t + 2 ms and moves the
rotors from t + 4 ms. Blocks of one phase see each other one period late.
"""

BASE_PERIOD = 0.002  # s
PLANT_PERIOD = 0.004  # s, plant, IMU, EKF2 and controller
ESTIMATE_OFFSET = 0.002  # s, the phase of estimators and controllers
CLOCK_PERIOD = 0.008  # s, grid on which sensors with odd rates and delay lines look at their clock
SUPERVISOR_PERIOD = 0.032  # s
