"""The second vehicle: a fixed wing that lands without GPS (Leonard 2016, Fig. 17)."""

from typing import Annotated, Any, Literal

import pandas as pd
from pydantic import Field
from pydrake.systems.framework import Diagram, DiagramBuilder

from plants.fixed_wing import FixedWing, FixedWingConfig
from plants.recorded_flight import RecordedFlight, RecordedFlightConfig
from plants.terrain import FlatTerrain, Terrain
from systems.configuration import StructureChangedError, configuration, require_same_structure
from systems.controllers.fixed_wing_flight_controller import FixedWingFlightControllerConfig
from systems.controllers.fixed_wing_guidance import RouteConfig
from systems.controllers.fixed_wing_reference_flight import reference_flight
from systems.estimators.runway_error_filter import FILTER_INPUTS, RunwayErrorFilterConfig
from systems.estimators.runway_improved_filter import RunwayImprovedFilterConfig
from systems.estimators.runway_record import RunwayRecordConfig
from systems.runway_frames import RunwayConfig
from systems.sensors.runway_airspeed import RunwayAirspeedConfig
from systems.sensors.runway_antenna import RunwayAntennaConfig
from systems.sensors.runway_baro_inertial import RunwayBaroInertialConfig
from systems.sensors.runway_camera import RunwayCameraConfig
from systems.sensors.runway_gps import RunwayGpsConfig
from systems.sensors.runway_heading import RunwayHeadingConfig
from systems.sensors.runway_inertial_drift import RunwayInertialDriftConfig
from systems.sensors.runway_laser import RunwayLaserConfig
from systems.sensors.runway_pixel_camera import RunwayPixelCameraConfig
from systems.sensors.runway_tracker import RunwayTrackerConfig
from systems.sensors.runway_wheel_encoder import RunwayWheelEncoderConfig
from systems.supervisors.runway_phases import RunwayPhasesConfig

OUTPUTS = ("state", "estimate", "phase", "guidance", "command", "passages", "end")


@configuration
class LandingWithoutGpsScenario:
    """A landing without GPS; the defaults are the reference of section 6.4 in closed loop."""

    kind: Literal["landing_without_gps"] = "landing_without_gps"
    name: str = "landing_without_gps"
    seed: int = 0
    duration: float = 1800.0  # s, the end if the aircraft has not come to rest by then
    runway: RunwayConfig = Field(default_factory=RunwayConfig)
    terrain: Terrain = Field(default_factory=FlatTerrain)
    # a recorded flight makes it an open loop (5.2)
    aircraft: Annotated[FixedWingConfig | RecordedFlightConfig, Field(discriminator="kind")] = (
        Field(default_factory=FixedWingConfig)
    )
    inertial: RunwayInertialDriftConfig = Field(default_factory=RunwayInertialDriftConfig)
    baro: RunwayBaroInertialConfig = Field(default_factory=RunwayBaroInertialConfig)
    # On final from the start: one fix, with the spread that the return leaves. The thesis calls
    # its own initial errors "a bit optimistic, especially on the speed" (6.1).
    gps: RunwayGpsConfig = Field(
        default_factory=lambda: RunwayGpsConfig(
            horizontal_noise=50.0, vertical_noise=5.0, speed_noise=0.2
        )
    )
    antenna: RunwayAntennaConfig = Field(default_factory=RunwayAntennaConfig)
    # geometric, or pixels: the runway drawn and the point followed in the pictures
    camera: Annotated[RunwayCameraConfig | RunwayPixelCameraConfig, Field(discriminator="kind")] = (
        Field(default_factory=RunwayCameraConfig)
    )
    tracker: RunwayTrackerConfig = Field(default_factory=RunwayTrackerConfig)
    laser: RunwayLaserConfig = Field(default_factory=RunwayLaserConfig)
    heading: RunwayHeadingConfig = Field(default_factory=RunwayHeadingConfig)
    wheel_encoder: RunwayWheelEncoderConfig = Field(default_factory=RunwayWheelEncoderConfig)
    airspeed: RunwayAirspeedConfig = Field(default_factory=RunwayAirspeedConfig)
    filter: Annotated[
        RunwayErrorFilterConfig | RunwayImprovedFilterConfig, Field(discriminator="kind")
    ] = Field(default_factory=RunwayErrorFilterConfig)
    phases: RunwayPhasesConfig = Field(default_factory=RunwayPhasesConfig)
    flight_controller: FixedWingFlightControllerConfig = Field(
        default_factory=lambda: FixedWingFlightControllerConfig(route=RouteConfig(waypoints=[]))
    )
    record: RunwayRecordConfig = Field(default_factory=RunwayRecordConfig)


class LandingWithoutGpsDiagram:
    """The wiring, and the systems by name so that they can be configured anew.

    Attributes
    ----------
    diagram : Diagram
        With the output ports `OUTPUTS`.
    systems : dict
        Every system by its name in the diagram.
    """

    def __init__(self, scenario: LandingWithoutGpsScenario):
        self._scenario = scenario
        builder = DiagramBuilder()
        seed, runway, terrain = scenario.seed, scenario.runway, scenario.terrain
        aircraft: FixedWing | RecordedFlight
        if isinstance(scenario.aircraft, RecordedFlightConfig):
            aircraft = scenario.aircraft.add_to(
                builder, "aircraft", seed, runway, terrain, _flight(scenario)
            )
            recorded = aircraft.recorded_sensors
            seen = "seen_state"
        else:
            aircraft = scenario.aircraft.add_to(builder, "aircraft", seed, runway, terrain)
            recorded = ()
            seen = "state"
        self._recorded = recorded
        self.systems: dict[str, Any] = {"aircraft": aircraft}
        simulated = {s: sensor for s, sensor in _MEASUREMENTS.items() if s not in recorded}
        drawn = scenario.camera.kind == "pixels" and simulated.pop("picture", "") != ""
        for name in (*simulated.values(), *_WITH_RUNWAY):
            self.systems[name] = getattr(scenario, name).add_to(builder, name, seed, runway)
        self.systems["phases"] = scenario.phases.add_to(builder, "phases", seed)
        if isinstance(scenario.camera, RunwayPixelCameraConfig) and drawn:
            self.systems["camera"] = scenario.camera.add_to(
                builder, "camera", seed, runway, scenario.tracker
            )
        port = {
            "state": aircraft.GetOutputPort("state"),
            "seen_state": aircraft.GetOutputPort(seen),
            "estimate": self.systems["filter"].GetOutputPort("estimate"),
            "phase": self.systems["phases"].GetOutputPort("status"),
            "guidance": self.systems["flight_controller"].GetOutputPort("guidance"),
            "command": self.systems["flight_controller"].GetOutputPort("command"),
            "passages": self.systems["record"].GetOutputPort("passages"),
            "end": self.systems["record"].GetOutputPort("end"),
        }
        for signal, sensor in simulated.items():
            port[signal] = self.systems[sensor].GetOutputPort("measurement")
        if drawn:
            port["picture"] = self.systems["camera"].GetOutputPort("measurement")
        for signal in recorded:
            port[signal] = aircraft.GetOutputPort(signal)

        def connect(name: str, **inputs: str) -> None:
            for target, source in inputs.items():
                builder.Connect(port[source], self.systems[name].GetInputPort(target))

        connect("aircraft", command="command")
        for sensor in simulated.values():
            if sensor != "tracker":
                connect(sensor, state="state")
        if "tracker" in self.systems:
            self.systems["camera"] = scenario.camera.add_to(builder, "camera", seed, runway)
            port["raw_picture"] = self.systems["camera"].GetOutputPort("measurement")
            connect("camera", state="seen_state")
            connect("tracker", picture="raw_picture", state="seen_state")
        connect("filter", **{name: name for name, _ in FILTER_INPUTS})
        signals = ("estimate", "guidance", "fix", "laser", "picture", "wheel_speed")
        connect("phases", **{name: name for name in signals})
        connect("flight_controller", estimate="estimate", phase="phase")
        connect("record", state="state", estimate="estimate", phase="phase")
        if drawn:
            connect("camera", state="seen_state")
        for name in OUTPUTS:
            builder.ExportOutput(port[name], name)
        self.diagram: Diagram = builder.Build()
        self.diagram.set_name("landing_without_gps")

    @property
    def scenario(self) -> LandingWithoutGpsScenario:
        """The scenario in force."""
        return self._scenario

    def configure(self, scenario: LandingWithoutGpsScenario) -> None:
        """Take over another scenario of the same structure for the next run.

        Raises
        ------
        StructureChangedError
            Where the diagram would have to be built anew.
        """
        for name in ("aircraft", "filter", "camera"):
            require_same_structure(getattr(self._scenario, name), getattr(scenario, name), "kind")
        aircraft, seed, runway = self.systems["aircraft"], scenario.seed, scenario.runway
        site = (runway, scenario.terrain)
        if isinstance(scenario.aircraft, RecordedFlightConfig):
            aircraft.configure(scenario.aircraft, seed, *site, _flight(scenario))
            if aircraft.recorded_sensors != self._recorded:
                raise StructureChangedError(
                    f"{scenario.aircraft.path} holds other sensors than the flight that the "
                    "diagram was built with: build a new diagram"
                )
        else:
            aircraft.configure(scenario.aircraft, seed, *site)
        for name, system in self.systems.items():
            if isinstance(scenario.camera, RunwayPixelCameraConfig) and name == "camera":
                system.configure(scenario.camera, seed, runway, scenario.tracker)
            elif name not in ("aircraft", "phases"):
                system.configure(getattr(scenario, name), seed, runway)
        self.systems["phases"].configure(scenario.phases, seed)
        self._scenario = scenario


def _flight(scenario: LandingWithoutGpsScenario) -> pd.DataFrame | None:
    """The reference flight, where the scenario replays it; None where it names a file."""
    aircraft = scenario.aircraft
    assert isinstance(aircraft, RecordedFlightConfig)
    if aircraft.path:
        return None
    return reference_flight(
        scenario.flight_controller, scenario.runway, scenario.terrain, aircraft.flight_seed
    )


# what each measurement is called on its way, and the sensor it comes from
_MEASUREMENTS = {
    "inertial": "inertial",
    "baro": "baro",
    "fix": "gps",
    "antenna": "antenna",
    "picture": "tracker",
    "laser": "laser",
    "heading": "heading",
    "wheel_speed": "wheel_encoder",
    "airspeed": "airspeed",
}
_WITH_RUNWAY = ("filter", "flight_controller", "record")
