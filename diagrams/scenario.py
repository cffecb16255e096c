"""The scenario: every number of an experiment in one tree of dataclasses.

This file only gathers the configurations that stand beside their systems. A new
sensor, estimator or routine is one new file and one line in a union here.
"""

from copy import deepcopy
from dataclasses import fields
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field

from diagrams.blocks import at_path
from diagrams.landing_without_gps import LandingWithoutGpsScenario
from plants.multirotor import MultirotorConfig
from plants.pads import PadConfig
from plants.touchdown import TouchdownConfig
from plants.wind import WindConfig
from systems.configuration import Finite, Positive, configuration
from systems.controllers.multirotor_cascade import MultirotorCascadeConfig
from systems.data_recorder import DataRecorderConfig
from systems.estimators.ardupilot_target import ArduPilotTargetConfig
from systems.estimators.ekf2.ekf2 import Ekf2Config
from systems.estimators.ekf2_selector import Ekf2SelectorConfig
from systems.estimators.multi_hypothesis_target import MultiHypothesisTargetConfig
from systems.estimators.px4_target import PX4TargetConfig, PX4VisionTargetConfig
from systems.estimators.svgs_companion import SvgsCompanionConfig
from systems.schedule import CLOCK_PERIOD, on_grid
from systems.sensors.barometer import BarometerConfig
from systems.sensors.gnss import GnssConfig
from systems.sensors.imu import ImuConfig
from systems.sensors.infrared_camera import InfraredCameraConfig
from systems.sensors.magnetometer import MagnetometerConfig
from systems.sensors.marker_camera import MarkerCameraConfig
from systems.sensors.range_finder import RangeFinderConfig
from systems.sensors.svgs_camera import SvgsCameraConfig
from systems.signals.delay_line import DelayLineConfig, UniformLatency
from systems.signals.fault_injector import FaultInjectorConfig
from systems.supervisors.cone import ConeConfig
from systems.supervisors.landing_supervisor import LandingSupervisorConfig


@configuration
class Origin:
    """Where W's origin, the landing pad, lies on Earth."""

    latitude: Annotated[Finite, Field(ge=-90.0, le=90.0)] = 39.3648  # deg; Volos
    longitude: Annotated[Finite, Field(ge=-180.0, le=180.0)] = 22.9470  # deg
    altitude: Finite = 30.0  # m above mean sea level


@configuration
class GnssChannel:
    """A GNSS receiver and its way to the navigation filter."""

    sensor: GnssConfig = Field(default_factory=GnssConfig)
    faults: FaultInjectorConfig | None = None  # null: no injector, and no commands to it
    latency: DelayLineConfig = Field(  # s; PX4's EKF2_GPS_DELAY assumes 0.11
        default_factory=lambda: DelayLineConfig(processing=0.11, period=0.04)
    )


@configuration
class MarkerCameraChannel:
    """The marker camera, the faults injected behind it, and its way to the autopilot."""

    sensor: MarkerCameraConfig = Field(default_factory=MarkerCameraConfig)
    faults: FaultInjectorConfig | None = None  # null: no injector, and no commands to it
    latency: DelayLineConfig = Field(  # s; thesis 4.2: frame processing about 50 ms
        default_factory=lambda: DelayLineConfig(processing=0.05, period=CLOCK_PERIOD)
    )


@configuration
class InfraredCameraChannel:
    """The IR-LOCK camera, the faults injected behind it, and its way to the autopilot."""

    sensor: InfraredCameraConfig = Field(default_factory=InfraredCameraConfig)
    faults: FaultInjectorConfig | None = None  # null: no injector, and no commands to it
    latency: DelayLineConfig = Field(  # s; one 50 Hz frame from exposure to the I2C read-out
        default_factory=lambda: DelayLineConfig(processing=0.02, period=CLOCK_PERIOD)
    )


@configuration
class SvgsCameraChannel:
    """The SVGS phone, the faults injected behind it, and its way to the companion computer."""

    sensor: SvgsCameraConfig = Field(default_factory=SvgsCameraConfig)
    faults: FaultInjectorConfig | None = None  # null: no injector, and no commands to it
    # s; SVGS paper 2.4: 175 to 230 ms to the flight controller, of which the three nodes of the
    # companion computer take 64 to 69 ms
    latency: DelayLineConfig = Field(
        default_factory=lambda: DelayLineConfig(
            latency=UniformLatency(shortest=0.110, longest=0.162)
        )
    )


@configuration
class PadGnssChannel:
    """A GNSS receiver on the pad, and its way to the vehicle by radio."""

    sensor: GnssConfig = Field(default_factory=GnssConfig)
    faults: FaultInjectorConfig | None = None  # null: no injector, and no commands to it
    # s; the receiver's 0.11, and half of a SiK radio's turn (MAX_WINDOW, 131 ms) on the way
    latency: DelayLineConfig = Field(
        default_factory=lambda: DelayLineConfig(processing=0.11, transport=0.065, period=0.04)
    )


@configuration
class Sensors:
    """Every sensor on board, and the pad's receiver; a channel that is null is not there."""

    imu: ImuConfig = Field(default_factory=ImuConfig)
    imu_2: ImuConfig | None = None  # for a second navigation filter, see `selector`
    imu_3: ImuConfig | None = None
    gnss: GnssChannel | None = Field(default_factory=GnssChannel)
    barometer: BarometerConfig | None = Field(default_factory=BarometerConfig)
    magnetometer: MagnetometerConfig | None = Field(default_factory=MagnetometerConfig)
    range_finder: RangeFinderConfig | None = Field(default_factory=RangeFinderConfig)
    marker_camera: MarkerCameraChannel | None = Field(default_factory=MarkerCameraChannel)
    infrared_camera: InfraredCameraChannel | None = Field(default_factory=InfraredCameraChannel)
    svgs_camera: SvgsCameraChannel | None = None
    pad_gnss: PadGnssChannel | None = None


LandingTargetConfig = Annotated[
    ArduPilotTargetConfig
    | PX4TargetConfig
    | PX4VisionTargetConfig
    | MultiHypothesisTargetConfig
    | SvgsCompanionConfig,
    Field(discriminator="kind"),
]


@configuration
class RecordingConfig:
    """What goes into the log, how often."""

    # s; measurements that come faster than every 40 ms are looked for twice as often
    period: Annotated[float, AfterValidator(on_grid)] = 0.04
    imu: bool = False  # every 10 ms, so that the log can be replayed through a filter


@configuration
class MultirotorLanding:
    """A multirotor takes off, flies its mission and lands on a pad."""

    kind: Literal["multirotor_landing"] = "multirotor_landing"
    name: str = "unnamed"
    description: str = ""
    seed: Annotated[int, Field(ge=0)] = 0  # of all noise
    time_limit: Positive = 240.0  # s, the run ends here at the latest
    fidelity: Literal["pixels", "geometric"] = "geometric"  # of every camera
    measure_from: Literal["pad", "start"] = "pad"  # where the vehicle should have landed
    origin: Origin = Field(default_factory=Origin)
    vehicle: MultirotorConfig = Field(default_factory=MultirotorConfig)
    wind: WindConfig = Field(default_factory=WindConfig)
    pad: PadConfig = Field(default_factory=PadConfig)
    sensors: Sensors = Field(default_factory=Sensors)
    navigation: Ekf2Config = Field(default_factory=Ekf2Config)
    # Several filters, each on an inertial sensor of its own (imu, imu_2, imu_3); null: one filter
    selector: Ekf2SelectorConfig | None = None
    landing_target: LandingTargetConfig | None = Field(default_factory=ArduPilotTargetConfig)
    guidance: LandingSupervisorConfig = Field(default_factory=LandingSupervisorConfig)
    control: MultirotorCascadeConfig = Field(default_factory=MultirotorCascadeConfig)
    touchdown: TouchdownConfig = Field(default_factory=TouchdownConfig)
    recording: RecordingConfig = Field(default_factory=RecordingConfig)
    data_recorder: DataRecorderConfig | None = None  # a companion computer's own record, as CSV


SCENARIO_KINDS: dict[str, type] = {
    "multirotor_landing": MultirotorLanding,
    "landing_without_gps": LandingWithoutGpsScenario,
}


def settled(scenario: MultirotorLanding) -> MultirotorLanding:
    """A copy in which what is said once for the whole scenario is known to every block.

    The vehicle, the pad, the origin, the cameras' fidelity and the time limit stand in
    one place of the scenario, and the blocks that need them get them from there.

    Raises
    ------
    ValueError
        If a block was given a value of its own that contradicts the shared one.
    """
    copy = deepcopy(scenario)
    for path, value, source in _shared(copy):
        owner_path, _, name = path.rpartition(".")
        owner = at_path(copy, owner_path)
        if owner is None:
            continue
        present = getattr(owner, name)
        if present not in (value, _default(owner, name)):
            raise ValueError(
                f"{path} is {present!r}, but {source} says {value!r}: leave {path} out"
            )
        setattr(owner, name, value)
    return copy


def _shared(s: MultirotorLanding) -> list[tuple[str, Any, str]]:
    """(path, value, where the value stands) of what blocks take over from the scenario."""
    origin = [s.origin.latitude, s.origin.longitude, s.origin.altitude]
    vehicle = s.vehicle.resolved_vehicle()
    shared: list[tuple[str, Any, str]] = [
        ("control.vehicle", vehicle, "vehicle"),
        ("control.flying", s.vehicle.flying, "vehicle.flying"),
        ("guidance.rotor_count", vehicle.rotor_count, "vehicle"),
        ("touchdown.rotor_count", vehicle.rotor_count, "vehicle"),
        ("touchdown.feet_height", min(foot[2] for foot in vehicle.feet), "vehicle"),
        ("touchdown.time_limit", s.time_limit, "time_limit"),
        ("navigation.origin", origin, "origin"),
        ("sensors.gnss.sensor.origin", origin, "origin"),
        ("sensors.pad_gnss.sensor.origin", origin, "origin"),
        ("sensors.barometer.origin_altitude", s.origin.altitude, "origin.altitude"),
        ("sensors.barometer.vehicle_mass", vehicle.mass, "vehicle"),
    ]
    if isinstance(s.guidance.routine, ConeConfig):
        feet = min(foot[2] for foot in vehicle.feet)
        shared.append(("guidance.routine.feet_height", feet, "vehicle"))
    shared += _seen_on_the_pad(s)
    cameras = s.sensors.marker_camera, s.sensors.infrared_camera
    for name, camera in zip(("marker", "infrared"), cameras, strict=True):
        sensor = f"sensors.{name}_camera.sensor"
        shared.append((f"{sensor}.fidelity", s.fidelity, "fidelity"))
        if camera is not None and not isinstance(s.landing_target, SvgsCompanionConfig):
            mount = f"landing_target.front_end.{name}"
            shared.append((f"{mount}_position", camera.sensor.position, f"{sensor}.position"))
            shared.append((f"{mount}_yaw", camera.sensor.yaw, f"{sensor}.yaw"))
    if s.sensors.svgs_camera is not None:
        sensor, node = "sensors.svgs_camera.sensor", "landing_target.transformations"
        shared.append((f"{sensor}.fidelity", s.fidelity, "fidelity"))
        phone = s.sensors.svgs_camera.sensor
        if isinstance(s.landing_target, MultiHypothesisTargetConfig):
            front_end = "landing_target.front_end"
            shared.append((f"{front_end}.beacons", phone.beacons, f"{sensor}.beacons"))
            shared.append((f"{front_end}.svgs_position", phone.position, f"{sensor}.position"))
            shared.append((f"{front_end}.svgs_yaw", phone.yaw, f"{sensor}.yaw"))
        if isinstance(s.landing_target, SvgsCompanionConfig):
            shared.append((f"{node}.beacons", phone.beacons, f"{sensor}.beacons"))
            shared.append((f"{node}.camera_position", phone.position, f"{sensor}.position"))
            shared.append((f"{node}.camera_yaw", phone.yaw, f"{sensor}.yaw"))
    if isinstance(s.landing_target, MultiHypothesisTargetConfig):
        shared.append(("landing_target.front_end.origin", origin, "origin"))
    if isinstance(s.landing_target, SvgsCompanionConfig):
        return shared  # the other estimators' front end listens to the other sensors
    if s.sensors.range_finder is not None:
        position = s.sensors.range_finder.position
        front_end = "landing_target.front_end.range_finder_position"
        shared.append((front_end, position, "sensors.range_finder.position"))
    return shared


def _seen_on_the_pad(s: MultirotorLanding) -> list[tuple[str, Any, str]]:
    """As `_shared`: what the marker and the infrared camera look for."""
    shared: list[tuple[str, Any, str]] = []
    if s.sensors.marker_camera is not None:
        sensor, marker = "sensors.marker_camera.sensor", s.pad.marker
        if marker is None:
            raise ValueError(
                "pad.marker is null, but there is a marker camera: "
                "set sensors.marker_camera to null"
            )
        shared.append((f"{sensor}.marker_ids", marker.ids().tolist(), "pad.marker"))
        shared.append((f"{sensor}.marker_sides", marker.sides().tolist(), "pad.marker"))
        shared.append((f"{sensor}.plate_side", s.pad.side, "pad.side"))
    if s.sensors.infrared_camera is not None:
        sensor, beacon = "sensors.infrared_camera.sensor", s.pad.beacon
        if beacon is None:
            raise ValueError(
                "pad.beacon is null, but there is an infrared camera: "
                "set sensors.infrared_camera to null"
            )
        shared.append((f"{sensor}.beacon_position", beacon.position, "pad.beacon.position"))
    return shared


def _default(owner: Any, name: str) -> Any:
    for field in fields(owner):
        if field.name == name:
            return getattr(type(owner)(), name)
    raise KeyError(name)
