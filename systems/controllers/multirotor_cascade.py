"""PX4's cascaded multicopter controller: from setpoint and estimate to rotor commands."""

import math
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import Field
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiagramBuilder,
    DiscreteValues,
    LeafSystem,
)

from plants.vehicles import VEHICLES, Vehicle, VehicleName
from systems.configuration import (
    NonNegative,
    Positive,
    Probability,
    Seconds,
    configuration,
    require_same_structure,
)
from systems.controllers import multirotor_cascade_kernel as kernel
from systems.controllers.multirotor_cascade_kernel import CASCADE_SETPOINTS, PARAMETERS, STATE
from systems.schedule import PLANT_PERIOD
from systems.signals.measurement import INERTIAL, SETPOINT, VEHICLE_ESTIMATE, no_measurement
from systems.signals.optional_input import optional_input

Degrees = Annotated[float, Field(ge=0.0, lt=90.0, description="an angle from 0 to 90 degrees")]

_NO_IMU = no_measurement(INERTIAL)
_TAKEOFF = STATE.index("takeoff")
_STATE, _COMMANDS = range(2)  # groups of the discrete state; the first ends with the setpoints


class CascadeGains(NamedTuple):
    """The gains of the two inner loops about the axes of B, each of shape (3,)."""

    attitude_p: np.ndarray  # 1/s
    rate_p: np.ndarray  # 1/s, angular acceleration a rate error: the rate loop's crossover, rad/s
    rate_i: np.ndarray  # 1/s2
    rate_d: np.ndarray  # 1, angular acceleration a measured angular acceleration
    rate_integral_limit: np.ndarray  # rad/s2


@configuration
class MultirotorCascadeConfig:
    """The controller's gains and limits under PX4's names.

    Defaults are those of PX4 v1.15 (parameter reference, and the list of parameters
    in a log of that version) unless a line says otherwise. Thrusts are fractions of
    the rotors' static maximum.
    """

    kind: Literal["multirotor_cascade"] = "multirotor_cascade"
    vehicle: VehicleName | Vehicle = "thesis_hexacopter"  # what the controller believes to fly
    flying: bool = False  # starts in flight with hovering rotors; otherwise by a take-off ramp

    # Position
    MPC_XY_P: NonNegative = 0.95  # (m/s)/m
    MPC_Z_P: NonNegative = 1.0  # (m/s)/m
    MPC_XY_VEL_MAX: Positive = 12.0  # m/s
    MPC_Z_VEL_MAX_UP: Positive = 3.0  # m/s
    MPC_Z_VEL_MAX_DN: Positive = 1.5  # m/s

    # Velocity
    MPC_XY_VEL_P_ACC: Positive = 1.8  # (m/s2)/(m/s)
    MPC_XY_VEL_I_ACC: NonNegative = 0.4  # (m/s2)/m
    MPC_XY_VEL_D_ACC: NonNegative = 0.2  # (m/s2)/(m/s2)
    MPC_Z_VEL_P_ACC: Positive = 4.0  # (m/s2)/(m/s)
    MPC_Z_VEL_I_ACC: NonNegative = 2.0  # (m/s2)/m
    MPC_Z_VEL_D_ACC: NonNegative = 0.0  # (m/s2)/(m/s2)
    MPC_VELD_LP: Positive = 5.0  # Hz, low pass of the velocity's derivative
    # Hz, low pass of the horizontal P, I and D together: ArduCopter's, 2 there; None: none, as PX4
    PSC_ACC_XY_FILT: Positive | None = None

    # Trajectory
    MPC_XY_CRUISE: Positive = 5.0  # m/s, where the setpoint names no maximum_speed
    MPC_ACC_HOR: Positive = 3.0  # m/s2
    MPC_ACC_UP_MAX: Positive = 4.0  # m/s2
    MPC_ACC_DOWN_MAX: Positive = 3.0  # m/s2
    MPC_JERK_AUTO: Positive = 4.0  # m/s3
    MPC_XY_TRAJ_P: Positive = 0.5  # (m/s)/m, close to the target; used for height too
    MPC_XY_ERR_MAX: Positive = 2.0  # m, the trajectory waits for a vehicle this far from it
    MPC_YAWRAUTO_MAX: Positive = 45.0  # deg/s
    MPC_YAWRAUTO_ACC: Positive = 60.0  # deg/s2

    # Thrust
    MPC_THR_HOVER: Probability | None = None  # None: from the vehicle's mass
    MPC_THR_MIN: Probability = 0.12
    MPC_THR_MAX: Probability = 1.0
    MPC_THR_XY_MARG: Probability = 0.3  # kept for horizontal control when height asks for more
    MPC_TILTMAX_AIR: Degrees = 45.0  # deg
    MPC_TILTMAX_LND: Degrees = 12.0  # deg, during the take-off ramp
    THR_MDL_FAC: Probability = 0.0  # 0: thrust linear in the command, as the plant's; 1: quadratic

    # Take-off and ground contact
    MPC_TKO_RAMP_T: NonNegative = 3.0  # s
    MPC_TKO_SPEED: Positive = 1.5  # m/s
    LNDMC_Z_VEL_MAX: Positive = 0.25  # m/s
    LNDMC_TRIG_TIME: NonNegative = 1.0  # s; ground contact is its first third

    # Attitude; None: by the rule of `MultirotorCascadeConfig.gains`
    MC_ROLL_P: Positive | None = None  # 1/s; PX4: 6.5
    MC_PITCH_P: Positive | None = None  # 1/s; PX4: 6.5
    MC_YAW_P: Positive = 2.8  # 1/s
    MC_YAW_WEIGHT: Annotated[Probability, Field(ge=0.1)] = 0.4
    MC_ROLLRATE_MAX: Positive = 220.0  # deg/s
    MC_PITCHRATE_MAX: Positive = 220.0  # deg/s
    MC_YAWRATE_MAX: Positive = 200.0  # deg/s

    # Body rates: angular acceleration = K (P error + I ∫error − D derivative)
    MC_ROLLRATE_P: Positive = 0.15
    MC_ROLLRATE_I: NonNegative = 0.2
    MC_ROLLRATE_D: NonNegative | None = None  # None: by the rule; PX4: 0.003
    MC_ROLLRATE_K: Positive | None = None  # rad/s2; None: by the rule
    MC_RR_INT_LIM: NonNegative = 0.3
    MC_PITCHRATE_P: Positive = 0.15
    MC_PITCHRATE_I: NonNegative = 0.2
    MC_PITCHRATE_D: NonNegative | None = None  # None: by the rule; PX4: 0.003
    MC_PITCHRATE_K: Positive | None = None  # rad/s2; None: by the rule
    MC_PR_INT_LIM: NonNegative = 0.3
    MC_YAWRATE_P: Positive = 0.2
    MC_YAWRATE_I: NonNegative = 0.1
    MC_YAWRATE_D: NonNegative = 0.0
    MC_YAWRATE_K: Positive | None = None  # rad/s2; None: by the rule
    MC_YR_INT_LIM: NonNegative = 0.3
    IMU_GYRO_CUTOFF: Annotated[Positive, Field(lt=0.5 / PLANT_PERIOD)] = 40.0  # Hz
    IMU_DGYRO_CUTOFF: Positive = 30.0  # Hz
    gyro_bias_time: Seconds = 1.0  # s, low pass of the gyro's bias against the estimate; own
    yaw_margin: Probability = 0.15  # of collective thrust that yaw may take; own

    def resolved_vehicle(self) -> Vehicle:
        """The vehicle that the mixer and the gains are made for."""
        return VEHICLES[self.vehicle]() if isinstance(self.vehicle, str) else self.vehicle

    @property
    def rotor_count(self) -> int:
        """The number of rotors, which shapes the diagram."""
        return self.resolved_vehicle().rotor_count

    def hover_thrust(self) -> float:
        """Collective thrust that carries the weight, as a fraction of the maximum."""
        if self.MPC_THR_HOVER is not None:
            return self.MPC_THR_HOVER
        return self.resolved_vehicle().hover_command()

    def gains(self) -> CascadeGains:
        """The gains of attitude and rate loops for this vehicle.

        The rule is the magnitude optimum, from the inside out (Kessler, "Über die
        Vorausberechnung optimal abgestimmter Regelkreise", Regelungstechnik 1955): an
        integrator behind small lags that sum to T is closed with the gain 1/(2T),
        which damps it with √½.

        * Roll and pitch rate: MC_*RATE_D / MC_*RATE_P is the rotors' lag τ and cancels
          it. What is left are the low passes of gyro and D term and three periods, two for
          transport and one for sampling and holding: T = √2/(2π·IMU_GYRO_CUTOFF) +
          1/(2π·IMU_DGYRO_CUTOFF) + 3·10 ms. So P·K = 1/(2T) = 12 rad/s.
        * Roll and pitch: min(6.5, 1/(2 (τ + 2T))), for a rate that is reached in τ + 2T.
        * Yaw rate, without D: min(1/(2 (T + τ)), 2·MC_YAW_P), no faster than the yaw
          loop needs, because drag torque is scarce; T without the D term's filter.
        * MC_*RATE_I / MC_*RATE_P stays PX4's.

        With the Iris' lag of 19 ms this gives D/P = 0.019 s (PX4: 0.020 s) and 5.0 1/s;
        PX4, with periods of 1 to 4 ms, affords 6.5 1/s.
        """
        vehicle = self.resolved_vehicle()
        lag = 0.5 * (vehicle.time_constant_up + vehicle.time_constant_down)
        sampling = math.sqrt(2.0) / (2.0 * math.pi * self.IMU_GYRO_CUTOFF) + 3.0 * PLANT_PERIOD
        filters = sampling + 1.0 / (2.0 * math.pi * self.IMU_DGYRO_CUTOFF)
        p = np.array([self.MC_ROLLRATE_P, self.MC_PITCHRATE_P, self.MC_YAWRATE_P])
        i = np.array([self.MC_ROLLRATE_I, self.MC_PITCHRATE_I, self.MC_YAWRATE_I])
        limit = np.array([self.MC_RR_INT_LIM, self.MC_PR_INT_LIM, self.MC_YR_INT_LIM])
        d = np.array(
            [
                p[0] * lag if self.MC_ROLLRATE_D is None else self.MC_ROLLRATE_D,
                p[1] * lag if self.MC_PITCHRATE_D is None else self.MC_PITCHRATE_D,
                self.MC_YAWRATE_D,
            ]
        )
        tilt_crossover = 0.5 / filters
        yaw_crossover = min(0.5 / (sampling + lag), 2.0 * self.MC_YAW_P)
        crossover = np.array([tilt_crossover, tilt_crossover, yaw_crossover])
        given = (self.MC_ROLLRATE_K, self.MC_PITCHRATE_K, self.MC_YAWRATE_K)
        k = np.array(
            [w / g if own is None else own for w, g, own in zip(crossover, p, given, strict=True)]
        )
        attitude = min(6.5, 0.5 / (lag + 2.0 * filters))
        return CascadeGains(
            attitude_p=np.array(
                [
                    attitude if self.MC_ROLL_P is None else self.MC_ROLL_P,
                    attitude if self.MC_PITCH_P is None else self.MC_PITCH_P,
                    self.MC_YAW_P,
                ]
            ),
            rate_p=k * p,
            rate_i=k * i,
            rate_d=k * d,
            rate_integral_limit=k * limit,
        )

    def mixer(self) -> np.ndarray:
        """The rotors' shares of collective thrust and of angular acceleration, shape (N, 4).

        The pseudo-inverse of the vehicle's effectiveness in fractions of the maximum
        thrust and rad/s2 about B's axes. Raises `ValueError` if the rotors cannot
        give the four independently.
        """
        vehicle = self.resolved_vehicle()
        effect = vehicle.allocation_matrix()
        effect[0] /= vehicle.rotor_count * vehicle.maximum_thrust
        effect[1:] /= np.array(vehicle.inertia)[:, None]
        if np.linalg.matrix_rank(effect) < 4:
            raise ValueError("the vehicle's rotors cannot turn it about all three axes")
        mixer = np.linalg.pinv(effect)
        if mixer[:, 0].min() <= 0.0:
            raise ValueError("every rotor of the vehicle must lift in level hover")
        return np.ascontiguousarray(mixer)

    def parameters(self) -> np.ndarray:
        """The parameter vector of `multirotor_cascade_kernel`, shape (PARAMETERS.size,)."""
        gains = self.gains()
        k = PARAMETERS(PARAMETERS.zeros())
        k.period = PLANT_PERIOD
        k.hover_thrust = self.hover_thrust()
        k.thrust_minimum = self.MPC_THR_MIN
        k.thrust_maximum = self.MPC_THR_MAX
        k.thrust_horizontal_margin = self.MPC_THR_XY_MARG
        # PX4's land detector, ground contact with a known hover thrust
        k.thrust_contact = self.MPC_THR_MIN + 0.6 * max(k.hover_thrust - self.MPC_THR_MIN, 0.0)
        k.tilt_flight = math.radians(self.MPC_TILTMAX_AIR)
        k.tilt_takeoff = math.radians(self.MPC_TILTMAX_LND)
        k.position_xy, k.position_z = self.MPC_XY_P, self.MPC_Z_P
        k.velocity_p_xy, k.velocity_p_z = self.MPC_XY_VEL_P_ACC, self.MPC_Z_VEL_P_ACC
        k.velocity_i_xy, k.velocity_i_z = self.MPC_XY_VEL_I_ACC, self.MPC_Z_VEL_I_ACC
        k.velocity_d_xy, k.velocity_d_z = self.MPC_XY_VEL_D_ACC, self.MPC_Z_VEL_D_ACC
        k.velocity_derivative_gain = _low_pass_gain(0.5 / (math.pi * self.MPC_VELD_LP))
        k.correction_gain = (
            1.0
            if self.PSC_ACC_XY_FILT is None
            else _low_pass_gain(0.5 / (math.pi * self.PSC_ACC_XY_FILT))
        )
        k.speed_xy_maximum = self.MPC_XY_VEL_MAX
        k.speed_xy_cruise = self.MPC_XY_CRUISE
        k.speed_up, k.speed_down = self.MPC_Z_VEL_MAX_UP, self.MPC_Z_VEL_MAX_DN
        k.acceleration_xy = self.MPC_ACC_HOR
        k.acceleration_up, k.acceleration_down = self.MPC_ACC_UP_MAX, self.MPC_ACC_DOWN_MAX
        k.jerk = self.MPC_JERK_AUTO
        k.trajectory_gain = self.MPC_XY_TRAJ_P
        k.trajectory_error = self.MPC_XY_ERR_MAX
        k.takeoff_ramp, k.takeoff_speed = self.MPC_TKO_RAMP_T, self.MPC_TKO_SPEED
        k.yaw_weight = self.MC_YAW_WEIGHT
        k.yaw_rate = math.radians(self.MPC_YAWRAUTO_MAX)
        k.yaw_acceleration = math.radians(self.MPC_YAWRAUTO_ACC)
        k.gyro_b_0, k.gyro_b_1, k.gyro_b_2, k.gyro_a_1, k.gyro_a_2 = _butterworth(
            self.IMU_GYRO_CUTOFF
        )
        k.rate_derivative_gain = _low_pass_gain(0.5 / (math.pi * self.IMU_DGYRO_CUTOFF))
        k.gyro_bias_gain = _low_pass_gain(self.gyro_bias_time)
        k.thrust_model_factor = self.THR_MDL_FAC
        k.yaw_margin = self.yaw_margin
        k.contact_time = self.LNDMC_TRIG_TIME / 3.0
        k.contact_speed = self.LNDMC_Z_VEL_MAX
        vector = k[:]
        vector[PARAMETERS.slice("attitude")] = gains.attitude_p
        vector[PARAMETERS.slice("rate_p")] = gains.rate_p
        vector[PARAMETERS.slice("rate_i")] = gains.rate_i
        vector[PARAMETERS.slice("rate_d")] = gains.rate_d
        vector[PARAMETERS.slice("rate_integral_limit")] = gains.rate_integral_limit
        vector[PARAMETERS.slice("rate_limit")] = np.radians(
            [self.MC_ROLLRATE_MAX, self.MC_PITCHRATE_MAX, self.MC_YAWRATE_MAX]
        )
        return vector

    def initial_state(self) -> np.ndarray:
        """The controller's state before its first event, shape (STATE.size,)."""
        state = STATE.zeros()
        state[_TAKEOFF] = 1.0 if self.flying else 0.0
        return state

    def initial_commands(self) -> np.ndarray:
        """The rotor commands before the first event, shape (N,)."""
        if not self.flying:
            return np.zeros(self.rotor_count)
        thrusts = self.mixer()[:, 0] * self.hover_thrust()
        return np.array([kernel.command_of_thrust(t, self.THR_MDL_FAC) for t in thrusts])

    def add_to(self, builder: DiagramBuilder, name: str, seed: int = 0) -> "MultirotorCascade":
        """Add a `MultirotorCascade` of this configuration to `builder`."""
        return builder.AddNamedSystem(name, MultirotorCascade(self, seed))


def _low_pass_gain(time_constant: float) -> float:
    """The gain per event of a discrete first-order low pass, exact for a held input."""
    if time_constant == 0.0:
        return 1.0
    return 1.0 - math.exp(-PLANT_PERIOD / time_constant)


def _butterworth(cutoff: float) -> tuple[float, float, float, float, float]:
    """b0, b1, b2, a1, a2 of a second-order Butterworth low pass by the bilinear transform."""
    c = 1.0 / math.tan(math.pi * cutoff * PLANT_PERIOD)
    norm = 1.0 / (1.0 + math.sqrt(2.0) * c + c * c)
    return (
        norm,
        2.0 * norm,
        norm,
        2.0 * (1.0 - c * c) * norm,
        (1.0 - math.sqrt(2.0) * c + c * c) * norm,
    )


class MultirotorCascade(LeafSystem):
    """PX4's multicopter control: position, velocity, attitude and rate loops, and the mixer.

    .. pydrake_system::

        name: MultirotorCascade
        input_ports:
        - estimate
        - imu (optional)
        - setpoint
        output_ports:
        - rotor_commands
        - setpoints

    | port | layout | meaning |
    |---|---|---|
    | estimate | VEHICLE_ESTIMATE | the vehicle as its navigation filter knows it |
    | imu (optional) | INERTIAL | gyro of the rate loop; unconnected: the estimate's rate |
    | setpoint | SETPOINT | what to do; see below |
    | rotor_commands | (N,) | normalised commands 0..1 in the vehicle's order of rotors |
    | setpoints | CASCADE_SETPOINTS | what each stage asked of the next, for logs |

    Structure and parameters are those of PX4's documentation ("Controller Diagrams",
    "Multicopter PID Tuning Guide", "Jerk-limited Type Trajectory", parameter
    reference, v1.15), in frames W and B.

    Setpoint. A finite p is flown to, with v as feed-forward (0 if NaN); where p is NaN,
    v is tracked; where both are NaN, or the estimate is not valid, the axis asks for no
    acceleration. A finite a is added to the acceleration that is asked for, as in PX4's
    trajectory_setpoint. A NaN yaw holds the heading. armed = 0 stops the rotors at once.

    Trajectory, all in state: a target speed v* = v + min(√-law(p − p_ref),
    maximum_speed), followed by v_ref with at most MPC_ACC_* and MPC_JERK_AUTO and
    integrated to p_ref. The √-law is MPC_XY_TRAJ_P·distance close by and √(2a·distance)
    further off. Horizontally the limits hold for the vector. p_ref waits for a
    vehicle that is MPC_XY_ERR_MAX behind and jumps when the estimate is reset. Yaw
    turns within MPC_YAWRAUTO_MAX and MPC_YAWRAUTO_ACC.

        position    v_sp = v_ref + P (p_ref − p)
        velocity    a_sp = a + a_ref + P (v_sp − v) + ∫ I (v_sp − v) − D v̇, horizontally
                    all but a + a_ref behind PSC_ACC_XY_FILT where that is set
        thrust      along (a_sp,x, a_sp,y, g), tilted by at most MPC_TILTMAX_AIR; its
                    vertical part is hover·(1 + a_sp,z/g); vertical goes before horizontal
                    but for MPC_THR_XY_MARG
        attitude    w_sp = P ∘ 2 sgn(e₀) e₁₂₃ + yaw rate of the trajectory; e: the shortest
                    turn to the thrust's direction, then MC_YAW_WEIGHT of the turn about it
        rates       α_sp = K (P (w_sp − w) + ∫ I (w_sp − w) − D ẇ)
        mixer       pseudo-inverse; roll and pitch before thrust before yaw; see `allocate`

    All loops run at 100 Hz (PX4: 50 Hz, 250 Hz, 1 kHz and more), the smoother and the
    mixer's desaturation are our own, and the hover thrust is known, not estimated.
    The horizontal velocity integral is unwound by back-calculation, the others are
    clamped at saturation. Gains of the inner loops: `MultirotorCascadeConfig.gains`.

    Body rate. The gyro's sample is 10 ms younger than the estimate that is made from it
    at the same tick, so w is delta_angle/dt minus a bias: the last gyro sample minus
    the estimate's rate that came of it, low-passed with `gyro_bias_time`. Without a
    valid sample w is the estimate's rate. P and I see w behind IMU_GYRO_CUTOFF (second
    order), D its derivative behind IMU_DGYRO_CUTOFF (first order).

    Before the estimate's attitude is valid only disarming has an effect.

    Ground. Armed on the ground the rotors stand until the setpoint lies 0.3 m above or
    climbs. Then the climb rate rises within MPC_TKO_RAMP_T from the one at which the
    velocity controller wants no thrust to MPC_TKO_SPEED. Until the ramp's end the
    tilt is limited to MPC_TILTMAX_LND and all integrals are 0. Afterwards they stand
    still while collective thrust is below MPC_THR_MIN + 0.6 (hover − MPC_THR_MIN); if
    it stays there for a third of LNDMC_TRIG_TIME while the vehicle should sink and
    does not (LNDMC_Z_VEL_MAX), the ground carries it and the thrust is kept upright
    ("Land Detector Configuration", ground contact).

    | event | when | does |
    |---|---|---|
    | initialize | at the start | the initial state of the last `configure` |
    | update | every 10 ms from 0 | one pass through all stages |

    At t the estimate is of t − 20 ms and the gyro's sample the mean from t − 20 ms to
    t − 10 ms; the plant takes the commands at t + 10 ms and holds them for 10 ms.
    """

    def __init__(self, config: MultirotorCascadeConfig, seed: int = 0):
        super().__init__()
        self._built = config
        self.configure(config, seed)
        self._estimate = self.DeclareVectorInputPort("estimate", VEHICLE_ESTIMATE.size).Eval
        self._imu = optional_input(self.DeclareVectorInputPort("imu", INERTIAL.size), _NO_IMU)
        self._setpoint = self.DeclareVectorInputPort("setpoint", SETPOINT.size).Eval
        declare: Any = self.DeclareDiscreteState  # its stub mistypes arrays
        declare(np.concatenate((config.initial_state(), CASCADE_SETPOINTS.zeros())))
        commands = declare(config.initial_commands())
        self.DeclareStateOutputPort("rotor_commands", commands)
        self.DeclareVectorOutputPort(
            "setpoints", CASCADE_SETPOINTS.size, self._calc_setpoints, {self.xd_ticket()}
        )
        self.DeclareInitializationDiscreteUpdateEvent(self._initialize)
        self.DeclarePeriodicDiscreteUpdateEvent(PLANT_PERIOD, 0.0, self._update)

    def configure(self, config: MultirotorCascadeConfig, seed: int = 0) -> None:
        """Take over another configuration; the number of rotors must stay the same."""
        require_same_structure(self._built, config, "rotor_count")
        self._config = config
        self._parameters = config.parameters()
        self._mixer = config.mixer()

    @property
    def config(self) -> MultirotorCascadeConfig:
        """The configuration in force."""
        return self._config

    def _initialize(self, context: Context, values: DiscreteValues) -> None:
        # Drake fixes the default state when a system is built. After `configure` it is replaced
        # here, unless the run is already under way.
        state = values.get_mutable_value(_STATE)[: STATE.size]
        if context.get_time() == 0.0 and np.array_equal(state, self._built.initial_state()):
            state[:] = self._config.initial_state()
            values.get_mutable_value(_COMMANDS)[:] = self._config.initial_commands()

    def _update(self, context: Context, values: DiscreteValues) -> None:
        kernel.cascade_event(
            values.get_mutable_value(_STATE),
            values.get_mutable_value(_COMMANDS),
            self._estimate(context),
            self._imu(context),
            self._setpoint(context),
            self._parameters,
            self._mixer,
        )

    def _calc_setpoints(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(context.get_discrete_state(_STATE).value()[STATE.size :])
