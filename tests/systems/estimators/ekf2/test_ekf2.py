"""The filter as a block: ports, start, replay of PX4's stream through Drake, resets, structure."""

import numpy as np
import pydantic
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem

from systems.configuration import StructureChangedError
from systems.estimators.ekf2 import layout as at
from systems.estimators.ekf2 import messages
from systems.estimators.ekf2.ekf2 import Ekf2, Ekf2Config
from systems.estimators.ekf2.messages import DELAYED_STATE, INNOVATIONS, STATUS
from systems.frames import (
    attitude_ned_from_world,
    geodetic_from_world,
    world_from_geodetic,
)
from systems.schedule import PLANT_PERIOD
from systems.signals.measurement import (
    BAROMETER,
    EXTERNAL_VISION,
    GNSS,
    INERTIAL,
    MAGNETOMETER,
    RANGE_FINDER,
    VEHICLE_ESTIMATE,
    no_measurement,
)
from tests.system_contract import assert_matches_docstring, periodic_update
from tests.systems.estimators.ekf2.streams import (
    FLIGHT,
    FLIGHT_FIELD,
    flight_parameters,
    messages_by_tick,
    replay,
    samples,
)

LAYOUTS = {
    "imu": INERTIAL,
    "gnss": GNSS,
    "barometer": BAROMETER,
    "magnetometer": MAGNETOMETER,
    "range_finder": RANGE_FINDER,
    "external_vision": EXTERNAL_VISION,
}
ORIGIN = [47.397742, 8.545594, 488.0]
STREAM_PERIOD = 0.004  # s, of the IMU in the reference stream


class Recording(LeafSystem):
    """Puts recorded messages into ports at their time of arrival."""

    def __init__(self, ticks: dict[int, list[tuple[str, np.ndarray]]], period: float):
        super().__init__()
        self._ticks, self._period = ticks, period
        self._groups = {}
        for name, layout in LAYOUTS.items():
            self._groups[name] = self.DeclareDiscreteState(no_measurement(layout))
        self._groups["vehicle_status"] = self.DeclareDiscreteState([0.0, 1.0, 0.0])
        for name, group in self._groups.items():
            self.DeclareStateOutputPort(name, group)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context, discrete_state):
        for name, message in self._ticks.get(round(context.get_time() / self._period), ()):
            discrete_state.get_mutable_value(self._groups[name])[:] = message


class Replayed:
    """A recording wired to a filter, and the simulator."""

    def __init__(self, ticks, config: Ekf2Config, ports=(*LAYOUTS, "vehicle_status")):
        builder = DiagramBuilder()
        source = builder.AddSystem(Recording(ticks, config.period))
        self.ekf2 = config.add_to(builder, "ekf2")
        for name in ports:
            builder.Connect(source.GetOutputPort(name), self.ekf2.GetInputPort(name))
        self.diagram = builder.Build()
        self.simulator = Simulator(self.diagram)
        self.context = self.ekf2.GetMyMutableContextFromRoot(self.simulator.get_mutable_context())

    def start(self, time: float) -> None:
        self.simulator.get_mutable_context().SetTime(time)
        self.simulator.Initialize()

    def port(self, name: str):
        layouts = {
            "estimate": VEHICLE_ESTIMATE,
            "delayed_state": DELAYED_STATE,
            "innovations": INNOVATIONS,
            "status": STATUS,
        }
        value = self.ekf2.GetOutputPort(name).Eval(self.context)
        return layouts[name](np.array(value))

    @property
    def array(self) -> np.ndarray:
        return self.context.get_discrete_state(0).value()


def at_rest(seconds: float, yaw: float = 0.0) -> dict[int, list[tuple[str, np.ndarray]]]:
    """A vehicle that stands 20 m east and 10 m north of the origin, its nose at a yaw in W."""
    ticks = {}
    field = np.array([0.0129, 0.2174, -0.4304])  # gauss, W, the model at the origin
    c, s = np.cos(yaw), np.sin(yaw)
    field_B = np.array([c * field[0] + s * field[1], c * field[1] - s * field[0], field[2]])
    place = geodetic_from_world(np.array([20.0, 10.0, 0.0]), np.array(ORIGIN))
    for k in range(1, round(seconds / PLANT_PERIOD) + 1):
        now = k * PLANT_PERIOD
        header = [now, now, k, 1.0]
        dt = PLANT_PERIOD
        force = 9.8085 * dt  # gravity at this latitude
        ticks[k] = [("imu", np.array([*header, 0, 0, 0, 0, 0, force, dt, dt, 0]))]
        if k % 4 == 0:
            ticks[k].append(("magnetometer", np.array([*header, *field_B])))
            ticks[k].append(("barometer", np.array([*header, ORIGIN[2] + 3.0])))
        if k % 16 == 0:
            fix = [now - 0.11, now, k, 1.0, *place, 0, 0, 0, 0.5, 0.8, 0.2, 3, 14, 1.1]
            ticks[k].append(("gnss", np.array(fix)))
        ticks[k].append(("vehicle_status", np.array([1.0, 0.0, 0.0])))
    return ticks


def test_topology():
    assert_matches_docstring(Ekf2(Ekf2Config()))


def test_schedule_and_initial_state():
    ekf2 = Ekf2(Ekf2Config())
    assert periodic_update(ekf2) == (PLANT_PERIOD, 0.0)
    context = ekf2.CreateDefaultContext()
    estimate = VEHICLE_ESTIMATE(np.array(ekf2.GetOutputPort("estimate").Eval(context)))
    assert estimate.time_of_validity == -1.0
    assert estimate.q_WB_w == 1.0
    assert estimate.attitude_valid == estimate.horizontal_valid == estimate.vertical_valid == 0.0
    for name in ("delayed_state", "innovations", "status"):
        assert np.isfinite(ekf2.GetOutputPort(name).Eval(context)).all()
    status = STATUS(np.array(ekf2.GetOutputPort("status").Eval(context)))
    assert status.in_air == 1.0
    assert status.height_reference == at.UNKNOWN


def test_one_update_of_the_imu_alone():
    ekf2 = Ekf2(Ekf2Config())
    context = ekf2.CreateDefaultContext()
    sample = np.array([0.004, 0.004, 0, 1, 0, 0, 0.01, 0, 0, 0.05, 0.004, 0.004, 0])
    ekf2.GetInputPort("imu").FixValue(context, sample)
    estimate = VEHICLE_ESTIMATE(ekf2.EvalUniquePeriodicDiscreteUpdate(context).value(1))
    assert estimate.time_of_validity == pytest.approx(0.004)
    assert estimate.w_WB_B_z == pytest.approx(2.5)
    assert estimate.a_WB_z == pytest.approx(0.05 / 0.004 - 9.80665)


def test_a_vehicle_at_rest_finds_where_it_stands():
    yaw = 2.0
    config = Ekf2Config(origin=ORIGIN, parameters={"EKF2_REQ_GPS_H": 3.0})
    run = Replayed(at_rest(6.0, yaw), config)
    run.start(0.0)
    run.simulator.AdvanceTo(6.0)
    estimate = run.port("estimate")
    assert estimate.attitude_valid == estimate.horizontal_valid == estimate.vertical_valid == 1.0
    assert estimate[VEHICLE_ESTIMATE.slice("p_WB")] == pytest.approx([20.0, 10.0, 0.0], abs=0.1)
    assert estimate[VEHICLE_ESTIMATE.slice("v_WB")] == pytest.approx([0.0] * 3, abs=0.05)
    heading = 2.0 * np.arctan2(estimate.q_WB_z, estimate.q_WB_w)
    assert heading == pytest.approx(yaw, abs=0.02)
    assert estimate.horizontal_reset_counter > 0.0
    # the last jump: from "relative to the start" to the place on Earth
    assert estimate.horizontal_reset_x == pytest.approx(20.0, abs=0.2)
    status = run.port("status")
    assert status.gnss_pos == status.gnss_vel == status.gps_hgt == status.mag_hdg == 1.0
    assert run.port("innovations").gnss_pos_fused == 1.0
    delayed = run.port("delayed_state")
    assert delayed.time_of_validity == pytest.approx(estimate.time_of_validity - 0.190, abs=0.011)


def test_replay_through_drake_is_the_plain_replay():
    """Forty seconds of PX4's stream through ports, W and B, against the kernels fed directly."""
    stream = samples("flight", 40.0)
    plain = replay(stream, flight_parameters()).x
    config = Ekf2Config(
        parameters=FLIGHT | {"EKF2_GPS_DELAY": 112.0},
        earth_field=list(FLIGHT_FIELD),
        origin=ORIGIN,
        period=STREAM_PERIOD,
    )
    run = Replayed(messages_by_tick(stream, STREAM_PERIOD), config)
    run.start(1.0)
    run.simulator.AdvanceTo(41.004 + 1.5 * STREAM_PERIOD)  # the filter looks a tick later
    run.simulator.AdvancePendingEvents()
    drake = run.array
    own = np.zeros(plain.size, dtype=bool)
    own[at.ARRIVED : at.STATUS_SENT + 4] = True  # the ports' own book-keeping
    own[at.T_IN_AIR] = True  # the status says "in the air" from the start here
    own[int(plain[at.RING_STATUS + at.RING_DATA]) :] = True
    own[at.RING_STATUS : at.FIXED_SIZE] = True
    assert np.array_equal(drake[~own], plain[~own], equal_nan=True)

    estimate = run.port("estimate")
    q_ned = plain[at.OUT_QUATERNION : at.OUT_QUATERNION + 4]
    assert np.allclose(estimate[VEHICLE_ESTIMATE.slice("q_WB")], attitude_ned_from_world(q_ned))
    latitude, longitude, altitude = messages.output_position(plain, config.parameter_array())
    place = np.array([np.degrees(latitude), np.degrees(longitude), altitude])
    p_WB = world_from_geodetic(place, np.array(ORIGIN))
    assert np.allclose(estimate[VEHICLE_ESTIMATE.slice("p_WB")], p_WB, atol=1e-6)
    velocity = plain[at.OUT_VELOCITY : at.OUT_VELOCITY + 3]
    expected = [velocity[1], velocity[0], -velocity[2]]
    assert np.allclose(estimate[VEHICLE_ESTIMATE.slice("v_WB")], expected)
    P = plain[at.COVARIANCE : at.COVARIANCE + at.ERRORS**2].reshape(at.ERRORS, at.ERRORS)
    variances = np.diag(P)[[7, 6, 8]]
    assert np.allclose(estimate[VEHICLE_ESTIMATE.slice("position_variance")], variances)


def test_stamps_of_arrival_and_of_validity_agree():
    stream = samples("flight", 20.0)
    arrays = []
    for timestamps in ("arrival", "validity"):
        shifted = samples("flight", 20.0)
        if timestamps == "validity":
            for kind, row in zip(shifted.kinds, shifted.rows, strict=True):
                row[0] -= 200_000 if kind == "ev" else 0
        config = Ekf2Config(
            parameters=FLIGHT | {"EKF2_GPS_DELAY": 112.0},
            timestamps=timestamps,
            origin=ORIGIN,
            period=STREAM_PERIOD,
        )
        run = Replayed(messages_by_tick(shifted, STREAM_PERIOD), config)
        run.start(1.0)
        run.simulator.AdvanceTo(21.0)
        arrays.append(run.array.copy())
    assert len(stream.rows) > 6000
    assert np.array_equal(*arrays, equal_nan=True)


def test_a_run_can_be_repeated_in_one_diagram_and_resumed():
    stream = samples("flight", 6.0)
    config = Ekf2Config(parameters=FLIGHT, origin=ORIGIN, period=STREAM_PERIOD)
    run = Replayed(messages_by_tick(stream, STREAM_PERIOD), config)
    run.start(1.0)
    run.simulator.AdvanceTo(4.0)
    middle = run.simulator.get_context().Clone()
    run.simulator.AdvanceTo(7.0)
    first = run.array.copy()

    resumed = Simulator(run.diagram, middle)
    resumed.Initialize()
    resumed.AdvanceTo(7.0)
    context = run.ekf2.GetMyContextFromRoot(resumed.get_context())
    assert np.array_equal(context.get_discrete_state(0).value(), first, equal_nan=True)

    other = Ekf2Config(parameters=FLIGHT | {"EKF2_BARO_NOISE": 1.0}, period=STREAM_PERIOD)
    run.ekf2.configure(other)
    run.ekf2.configure(config)
    again = Simulator(run.diagram)
    again.get_mutable_context().SetTime(1.0)
    again.Initialize()
    again.AdvanceTo(7.0)
    context = run.ekf2.GetMyContextFromRoot(again.get_context())
    assert np.array_equal(context.get_discrete_state(0).value(), first, equal_nan=True)


def test_what_shapes_the_state_cannot_change():
    ekf2 = Ekf2(Ekf2Config())
    ekf2.configure(Ekf2Config(parameters={"EKF2_EVP_GATE": 10.0}))
    with pytest.raises(StructureChangedError, match="EKF2_DELAY_MAX"):
        ekf2.configure(Ekf2Config(parameters={"EKF2_DELAY_MAX": 400.0}))
    with pytest.raises(StructureChangedError, match="period"):
        ekf2.configure(Ekf2Config(period=0.001))


def test_unconnected_sensors_are_absent():
    stream = samples("flight", 3.0)
    run = Replayed(
        messages_by_tick(stream, STREAM_PERIOD),
        Ekf2Config(parameters=FLIGHT, period=STREAM_PERIOD),
        ports=("imu",),
    )
    run.start(1.0)
    run.simulator.AdvanceTo(4.0)
    status = run.port("status")
    assert status.in_air == 1.0
    assert status.mag == status.baro_hgt == status.ev_pos == status.gnss_pos == 0.0
    assert run.port("estimate").time_of_validity == pytest.approx(4.0, abs=0.01)


def test_configuration_names_its_mistakes(tmp_path):
    with pytest.raises(pydantic.ValidationError, match="did you mean EKF2_EVP_GATE"):
        Ekf2Config(parameters={"EKF2_EVP_GAT": 5.0})
    with pytest.raises(pydantic.ValidationError, match="whole number"):
        Ekf2Config(parameters={"EKF2_HGT_REF": 0.5})
    file = tmp_path / "vehicle.params"
    file.write_text("1\t1\tEKF2_EVP_GATE\t7.0\t9\n1\t1\tEKF2_EV_CTRL\t3\t6\n")
    config = Ekf2Config(parameter_file=str(file), parameters={"EKF2_EVP_GATE": 9.0})
    array = config.parameter_array()
    assert array[messages.prm.EKF2_EVP_GATE] == 9.0
    assert array[messages.prm.EKF2_EV_CTRL] == 3.0


def test_starts_as_last_configured_and_only_once():
    ekf2 = Ekf2(Ekf2Config())
    simulator = Simulator(ekf2)
    ekf2.configure(Ekf2Config(parameters={"EKF2_MIN_RNG": 0.4}))
    ekf2.get_input_port(0).FixValue(simulator.get_mutable_context(), no_measurement(INERTIAL))
    simulator.Initialize()
    x = simulator.get_mutable_context().get_mutable_discrete_state(0).get_mutable_value()
    assert x[at.TERRAIN] == 0.4
    x[at.INITIALISED], x[at.TERRAIN] = 1.0, 3.0  # a filter that has begun goes on
    simulator.Initialize()
    assert simulator.get_context().get_discrete_state(0).value()[at.TERRAIN] == 3.0
