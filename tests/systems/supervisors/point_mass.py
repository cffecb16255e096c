"""A vehicle and a target without sensors, for the tests of supervisors only.

A point mass follows setpoints with a first-order velocity, knows itself and the pad
exactly, and stands on the ground at z = 0. What the supervisor is told of the target can be
switched by height or time.
"""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiagramBuilder,
    DiscreteValues,
    EventStatus,
    LeafSystem,
)
from pydrake.systems.primitives import LogVectorOutput

from systems.schedule import SUPERVISOR_PERIOD
from systems.signals.measurement import (
    RANGE_FINDER,
    SETPOINT,
    SUPERVISOR_STATUS,
    TARGET_ESTIMATE,
    VEHICLE_ESTIMATE,
)
from systems.supervisors.landing_supervisor import LandingSupervisor, LandingSupervisorConfig

_PERIOD = 0.02  # s
_POSITION_GAIN = 1.0  # 1/s
_VELOCITY_GAIN = 3.0  # 1/s
_SPEED_UP, _SPEED_DOWN = 3.0, 1.5  # m/s


class PointMass(LeafSystem):
    """Vehicle, navigation filter, range finder and landing-target estimator in one."""

    def __init__(
        self,
        start: tuple[float, float] = (2.0, 0.0),
        pad: tuple[float, float] = (0.0, 0.0),
        pad_velocity: tuple[float, float] = (0.0, 0.0),
        visible: Callable[[float, float], bool] = lambda t, z: True,
        lost_time: float = 2.0,
        drift: float = 0.0,
        valid_from: float = 0.0,
        jump: tuple[float, float, float, float] | None = None,
        ranged: Callable[[float], bool] = lambda t: True,
        rotors: bool = False,
    ):
        """A plant.

        Parameters
        ----------
        start, pad, pad_velocity : pairs of float
            m and m/s, W.
        visible : function of time and height
            Whether the target is measured.
        lost_time : float
            s after which an unmeasured target is not acquired any more.
        drift : float
            m/s, by which one sigma of the target's place grows while it is not measured.
        valid_from : float
            s, from when the estimate is valid.
        jump : (time, x, y, z)
            When and by how much the estimate jumps (s, m).
        ranged : function of time
            Whether the range finder measures.
        rotors : bool
            Whether rotor commands fall on the ground, as a velocity integrator makes them.
        """
        super().__init__()
        self.pad, self.pad_velocity = np.array(pad), np.array(pad_velocity)
        self.visible, self.lost_time, self.valid_from = visible, lost_time, valid_from
        self.jump, self.ranged, self.rotors = jump, ranged, rotors
        self.drift = drift
        # p, v, time of the last sighting, thrust
        self.DeclareDiscreteState([*start, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0])
        self.DeclareVectorInputPort("setpoint", SETPOINT.size)
        size = VEHICLE_ESTIMATE.size
        self.DeclareVectorOutputPort("estimate", size, self._estimate, {self.xd_ticket()})
        size = TARGET_ESTIMATE.size
        self.DeclareVectorOutputPort("target", size, self._target, {self.xd_ticket()})
        size = RANGE_FINDER.size
        self.DeclareVectorOutputPort("range_finder", size, self._range, {self.xd_ticket()})
        self.DeclareVectorOutputPort("rotor_commands", 6, self._rotors, {self.xd_ticket()})
        self.DeclarePeriodicDiscreteUpdateEvent(_PERIOD, 0.0, self._update)

    def _offset(self, t: float) -> np.ndarray:
        if self.jump is None or t < self.jump[0]:
            return np.zeros(3)
        return np.array(self.jump[1:])

    def _update(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        t = context.get_time()
        state = context.get_discrete_state_vector().value().copy()
        setpoint = SETPOINT(self.EvalVectorInput(context, 0).value())
        p, v = state[:3], state[3:6]
        if setpoint.armed:
            wanted = np.array([setpoint.v_WB_x, setpoint.v_WB_y, setpoint.v_WB_z])
            goal = np.array([setpoint.p_WB_x, setpoint.p_WB_y, setpoint.p_WB_z])
            error = goal - (p + self._offset(t))
            wanted = wanted + np.where(np.isnan(goal), 0.0, _POSITION_GAIN * error)
            speed = np.hypot(wanted[0], wanted[1])
            if speed > setpoint.maximum_speed:
                wanted[:2] *= setpoint.maximum_speed / speed
            wanted[2] = np.clip(wanted[2], -_SPEED_DOWN, _SPEED_UP)
            v += _VELOCITY_GAIN * (wanted - v) * _PERIOD
        else:
            wanted = np.array([0.0, 0.0, -9.81])
            v[2] -= 9.81 * _PERIOD
        p += v * _PERIOD
        if p[2] <= 0.0 and v[2] <= 0.0:
            p[2] = v[0] = v[1] = v[2] = 0.0
            state[7] = max(0.0, state[7] - _PERIOD) if wanted[2] < 0.0 else 1.0
        else:
            state[7] = 1.0
        if self.visible(t, float(p[2])):
            state[6] = t
        discrete_state.set_value(0, state)
        return EventStatus.Succeeded()

    def _estimate(self, context: Context, output: BasicVector) -> None:
        t = context.get_time()
        state = context.get_discrete_state_vector().value()
        estimate = VEHICLE_ESTIMATE(VEHICLE_ESTIMATE.zeros())
        estimate.time_of_validity = t
        valid = float(t >= self.valid_from)
        estimate.attitude_valid = estimate.horizontal_valid = estimate.vertical_valid = valid
        estimate.q_WB_w = 1.0
        values = estimate[:]
        values[VEHICLE_ESTIMATE.slice("p_WB")] = state[:3] + self._offset(t)
        values[VEHICLE_ESTIMATE.slice("v_WB")] = state[3:6]
        if self.jump is not None and t >= self.jump[0]:
            estimate.horizontal_reset_counter = estimate.vertical_reset_counter = 1
            _, estimate.horizontal_reset_x, estimate.horizontal_reset_y, _ = self.jump
            estimate.vertical_reset = self.jump[3]
        output.SetFromVector(values)

    def _target(self, context: Context, output: BasicVector) -> None:
        t = context.get_time()
        state = context.get_discrete_state_vector().value()
        target = TARGET_ESTIMATE(TARGET_ESTIMATE.zeros())
        target.time_of_validity = t
        target.time_of_last_fusion = state[6]
        target.acquired = float(state[6] >= 0.0 and t - state[6] <= self.lost_time)
        pad = self.pad + self.pad_velocity * t
        target.p_BP_W_x, target.p_BP_W_y = pad - state[:2]
        target.p_BP_W_z = -state[2]
        spread = (self.drift * (t - state[6])) ** 2
        target.position_variance_x = target.position_variance_y = spread
        target.v_WP_x, target.v_WP_y = self.pad_velocity
        output.SetFromVector(target[:])

    def _range(self, context: Context, output: BasicVector) -> None:
        measurement = RANGE_FINDER(RANGE_FINDER.zeros())
        measurement.time_of_validity = measurement.time_of_arrival = context.get_time()
        measurement.valid = float(self.ranged(context.get_time()))
        measurement.range = context.get_discrete_state_vector().value()[2]
        output.SetFromVector(measurement[:])

    def _rotors(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(np.full(6, 0.5 * context.get_discrete_state_vector().value()[7]))


class Flight:
    """A flight of the point mass under a supervisor.

    Attributes
    ----------
    times : array of shape (n,)
        s, every 40 ms.
    setpoints, status, estimates : named views of shape (n,) each
        By field name.
    states : list of str
        The states in the order they were entered.
    """

    def __init__(
        self,
        config: LandingSupervisorConfig,
        plant: PointMass,
        duration: float = 120.0,
        range_finder: bool = True,
    ):
        """Fly until the supervisor has landed, for at most `duration` seconds."""
        builder = DiagramBuilder()
        self.supervisor: LandingSupervisor = config.add_to(builder, "supervisor")
        builder.AddNamedSystem("plant", plant)
        names = ["estimate", "target"]
        names += ["range_finder"] if range_finder else []
        names += ["rotor_commands"] if plant.rotors else []
        for name in names:
            builder.Connect(plant.GetOutputPort(name), self.supervisor.GetInputPort(name))
        builder.Connect(self.supervisor.GetOutputPort("setpoint"), plant.GetInputPort("setpoint"))
        logs = {
            name: LogVectorOutput(port, builder, SUPERVISOR_PERIOD)
            for name, port in (
                ("status", self.supervisor.GetOutputPort("status")),
                ("setpoint", self.supervisor.GetOutputPort("setpoint")),
                ("estimate", plant.GetOutputPort("estimate")),
            )
        }
        self.diagram = builder.Build()
        simulator = Simulator(self.diagram)
        context = simulator.get_context()
        self.plant_context = plant.GetMyContextFromRoot(context)
        status_port = self.supervisor.GetOutputPort("status")
        supervisor_context = self.supervisor.GetMyContextFromRoot(context)
        while context.get_time() < duration:
            simulator.AdvanceTo(context.get_time() + 0.5)
            if SUPERVISOR_STATUS(status_port.Eval(supervisor_context)).disarmed and (
                context.get_time() > plant.valid_from + 5.0
            ):
                simulator.AdvanceTo(context.get_time() + SUPERVISOR_PERIOD)
                break
        found = {name: log.FindLog(context) for name, log in logs.items()}
        self.times = found["status"].sample_times()
        self.status = SUPERVISOR_STATUS(found["status"].data())
        self.setpoints = SETPOINT(found["setpoint"].data())
        self.estimates = VEHICLE_ESTIMATE(found["estimate"].data())
        table = self.supervisor.machine.table
        indices = self.status.state.astype(int)
        changes = np.flatnonzero(np.diff(indices, prepend=-1))
        self.states = [table.states[i].name for i in indices[changes]]
        self.entered = [(table.states[indices[i]].name, self.times[i]) for i in changes]

        # Whatever else happens: the rotors do not stop in the air.
        stopped = np.flatnonzero(np.diff(self.status.disarmed) > 0.0)
        heights = self.estimates.p_WB_z - (plant.jump[3] if plant.jump is not None else 0.0)
        assert (heights[stopped] < 0.01).all(), "the rotors were stopped in the air"

    @property
    def position(self) -> np.ndarray:
        """The true position at the end, m."""
        return self.plant_context.get_discrete_state_vector().value()[:3].copy()

    @property
    def landed(self) -> bool:
        """Whether the flight ended in the state `landed`."""
        return self.states[-1] == "landed"

    @property
    def landing_time(self) -> float:
        """From the end of the mission to the stopped rotors, s."""
        return float(self.times[-1] - self.status.landing_started[-1])

    @property
    def transitions(self) -> set[tuple[str, str]]:
        """The pairs of states that were taken."""
        return set(pairwise(self.states))

    def time_of(self, state: str) -> float:
        """When a state was first entered, s."""
        return next(float(t) for name, t in self.entered if name == state)
