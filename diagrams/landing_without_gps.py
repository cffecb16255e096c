"""The second vehicle: a fixed wing that lands without GPS (Leonard 2016, Fig. 17)."""

from typing import Annotated, Any, Literal

import numpy as np
import pandas as pd
from pydantic import Field
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort
from pydrake.systems.primitives import Multiplexer

from diagrams.recording import Recording
from diagrams.runway_geometry import require_landing, same_but_for_seed
from plants.fixed_wing import FixedWing, FixedWingConfig
from plants.recorded_flight import RecordedFlight, RecordedFlightConfig
from plants.terrain import FlatTerrain, Terrain
from systems.configuration import (
    Positive,
    StructureChangedError,
    configuration,
    require_same_structure,
)
from systems.controllers.fixed_wing_flight_controller import FixedWingFlightControllerConfig
from systems.controllers.fixed_wing_guidance import RouteConfig
from systems.controllers.fixed_wing_reference_flight import reference_flight
from systems.estimators.runway_error_filter import RunwayErrorFilterConfig
from systems.estimators.runway_improved_filter import RunwayImprovedFilterConfig
from systems.estimators.runway_record import END, RunwayRecordConfig
from systems.runway_frames import (
    RunwayConfig,
)
from systems.sensors.runway_airspeed import RunwayAirspeedConfig
from systems.sensors.runway_antenna import RunwayAntennaConfig
from systems.sensors.runway_baro_inertial import RunwayBaroInertialConfig
from systems.sensors.runway_camera import RunwayCameraConfig, camera_parameters
from systems.sensors.runway_gps import RunwayGpsConfig
from systems.sensors.runway_heading import RunwayHeadingConfig
from systems.sensors.runway_inertial_drift import RunwayInertialDriftConfig
from systems.sensors.runway_laser import RunwayLaserConfig
from systems.sensors.runway_pixel_camera import RunwayPixelCameraConfig
from systems.sensors.runway_tracker import RunwayTrackerConfig
from systems.sensors.runway_wheel_encoder import RunwayWheelEncoderConfig
from systems.signals.noise import stream_key
from systems.signals.runway_measurement import (
    ANTENNA,
    FILTER_INPUTS,
    FIX,
    FIXED_WING_COMMAND,
    FIXED_WING_STATE,
    GUIDANCE,
    LASER_HEIGHT,
    NAVIGATION_ESTIMATE,
    PHASE_STATUS,
    PICTURE,
    SLOW_PERIOD,
)
from systems.supervisors.runway_phases import TABLE, Phase, RunwayPhasesConfig
from systems.supervisors.state_machine import to_dot
from systems.vision.runway_picture import draw_picture, draw_tracked_point

OUTPUTS = ("state", "estimate", "phase", "guidance", "command", "passages", "end")


@configuration
class LandingWithoutGpsScenario:
    """A landing without GPS; the defaults are the reference of section 6.4 in closed loop."""

    kind: Literal["landing_without_gps"] = "landing_without_gps"
    name: str = "landing_without_gps"
    description: str = ""
    seed: Annotated[int, Field(ge=0)] = 0  # of all noise and of every error drawn once a run
    time_limit: Positive = 1800.0  # s, the end if the aircraft has not come to rest by then
    runway: RunwayConfig = Field(default_factory=RunwayConfig)
    terrain: Terrain = Field(default_factory=FlatTerrain)
    # a recorded flight makes it an open loop (5.2)
    aircraft: Annotated[FixedWingConfig | RecordedFlightConfig, Field(discriminator="kind")] = (
        Field(default_factory=FixedWingConfig)
    )
    inertial: RunwayInertialDriftConfig = Field(default_factory=RunwayInertialDriftConfig)
    baro: RunwayBaroInertialConfig = Field(default_factory=RunwayBaroInertialConfig)
    # On final from the start: one fix, with the spread that the return leaves and what the filter
    # believes of it. The speed is what a gyro of 0.033 deg/h drifts in the twelve minutes since the
    # loss, R_T D (1 − cos ω_S t); the thesis's filter holds its speed error constant meanwhile
    gps: RunwayGpsConfig = Field(
        default_factory=lambda: RunwayGpsConfig(
            horizontal_noise=50.0,
            vertical_noise=5.0,
            speed_noise=0.4,
            reported_horizontal_accuracy=25.0,
            reported_speed_accuracy=0.04,
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
    ports : dict
        Output ports by their name in the log.
    recording : Recording
        What is recorded of them, every 80 ms.

    Raises
    ------
    ValueError
        For a terrain or a flight that cannot be read, and for a landing that is geometrically
        impossible, see `diagrams.runway_geometry`.
    """

    def __init__(self, scenario: LandingWithoutGpsScenario):
        self._scenario = scenario
        builder = DiagramBuilder()
        seed, runway, terrain = scenario.seed, scenario.runway, scenario.terrain
        aircraft: FixedWing | RecordedFlight
        self._flights: dict[str, pd.DataFrame] = {}
        if isinstance(scenario.aircraft, RecordedFlightConfig):
            aircraft = scenario.aircraft.add_to(
                builder, "aircraft", seed, runway, terrain, self._flight(scenario)
            )
            recorded = aircraft.recorded_sensors
            seen = "seen_state"
        else:
            aircraft = scenario.aircraft.add_to(builder, "aircraft", seed, runway, terrain)
            recorded = ()
            seen = "state"
        self._checked: LandingWithoutGpsScenario | None = None
        self._require_landing(scenario, aircraft)
        self._recorded = recorded
        self.systems: dict[str, Any] = {"aircraft": aircraft}
        simulated = {s: sensor for s, sensor in _MEASUREMENTS.items() if s not in recorded}
        drawn = scenario.camera.kind == "pixels" and simulated.pop("picture", "") != ""
        for name in (*simulated.values(), *_WITH_RUNWAY):
            self.systems[name] = getattr(scenario, name).add_to(builder, name, seed, runway)
        self.systems["phases"] = scenario.phases.add_to(builder, "phases", seed)
        self.systems["record"] = scenario.record.add_to(
            builder, "record", seed, runway, scenario.time_limit
        )
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
        # what is wrong with the recorded altitude is wrong with the laser made from it (6.1: "the
        # laser measurements are simulated"), not with the altimeter on board, nor with the fix,
        # which stands for the filter's initial parameters
        for sensor in simulated.values():
            if sensor != "tracker":
                connect(sensor, state=seen if sensor in ("baro", "gps") else "state")
        if "tracker" in self.systems:
            self.systems["camera"] = scenario.camera.add_to(builder, "camera", seed, runway)
            port["raw_picture"] = self.systems["camera"].GetOutputPort("measurement")
            connect("camera", state="seen_state")
            connect("tracker", picture="raw_picture", state="seen_state")
        gather = Multiplexer([layout.size for _, layout in FILTER_INPUTS])
        builder.AddNamedSystem("measurements", gather)
        for index, (name, _) in enumerate(FILTER_INPUTS):
            builder.Connect(port[name], gather.get_input_port(index))
        port["measurements"] = gather.get_output_port()
        connect("filter", measurements="measurements")
        signals = ("estimate", "guidance", "fix", "laser", "picture", "wheel_speed")
        connect("phases", **{name: name for name in signals})
        connect("flight_controller", estimate="estimate", phase="phase")
        connect("record", state="state", estimate="estimate", phase="phase")
        if drawn:
            connect("camera", state="seen_state")
        for name in OUTPUTS:
            builder.ExportOutput(port[name], name)
        self.ports: dict[str, OutputPort] = port
        self.recording = Recording()
        for name, layout in RECORDED.items():
            self.recording.add(port[name], name, layout, SLOW_PERIOD)
        self.recording.connect(builder)
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
        ValueError
            As the constructor does.
        """
        for name in ("aircraft", "filter", "camera"):
            require_same_structure(getattr(self._scenario, name), getattr(scenario, name), "kind")
        aircraft, seed, runway = self.systems["aircraft"], scenario.seed, scenario.runway
        site = (runway, scenario.terrain)
        if isinstance(scenario.aircraft, RecordedFlightConfig):
            aircraft.configure(scenario.aircraft, seed, *site, self._flight(scenario))
            if aircraft.recorded_sensors != self._recorded:
                raise StructureChangedError(
                    f"{scenario.aircraft.path} holds other sensors than the flight that the "
                    "diagram was built with: build a new diagram"
                )
        else:
            aircraft.configure(scenario.aircraft, seed, *site)
        self._require_landing(scenario, aircraft)
        for name, system in self.systems.items():
            if isinstance(scenario.camera, RunwayPixelCameraConfig) and name == "camera":
                system.configure(scenario.camera, seed, runway, scenario.tracker)
            elif name not in ("aircraft", "phases", "record"):
                system.configure(getattr(scenario, name), seed, runway)
        self.systems["phases"].configure(scenario.phases, seed)
        self.systems["record"].configure(scenario.record, seed, runway, scenario.time_limit)
        self._scenario = scenario

    def _require_landing(
        self, scenario: LandingWithoutGpsScenario, aircraft: FixedWing | RecordedFlight
    ) -> None:
        """Check what has not been checked yet; runs of a campaign differ in the seed alone."""
        if self._checked is None or not same_but_for_seed(scenario, self._checked):
            recorded = isinstance(aircraft, RecordedFlight)
            track = aircraft.model[0][:, 1:4] if recorded else None
            require_landing(scenario, aircraft.model[-1], track)
            self._checked = scenario

    def _flight(self, scenario: LandingWithoutGpsScenario) -> pd.DataFrame | None:
        """The reference flight, where the scenario replays it; None where it names a file."""
        aircraft = scenario.aircraft
        assert isinstance(aircraft, RecordedFlightConfig)
        if aircraft.path:
            return None
        flown = (
            scenario.flight_controller, scenario.runway, scenario.terrain, aircraft.flight_seed
        )  # fmt: skip
        key = repr(flown)
        if key not in self._flights:
            self._flights[key] = reference_flight(*flown)
        return self._flights[key]

    def evaluate(self, name: str, context: Context) -> np.ndarray:
        """The value of the port called `name` in the root context."""
        port = self.ports[name]
        return port.Eval(port.get_system().GetMyContextFromRoot(context))

    def state(self, context: Context) -> str:
        """The phase, in words."""
        return self.state_names()[int(self.evaluate("phase", context)[0])].replace("_", " ")

    def state_names(self) -> list[str]:
        """The names of the phases, by index."""
        return [state.name for state in TABLE.states]

    def states_dot(self) -> str:
        """The transition table of the phases as DOT text."""
        return to_dot(TABLE, "phases", self.systems["phases"])

    def is_landing(self, context: Context) -> bool:
        """Whether the camera's picture matters: from the final to the touchdown."""
        return Phase.FINAL <= self.evaluate("phase", context)[0] < Phase.BRAKING

    def camera_pictures(self, context: Context) -> list[tuple[str, np.ndarray]]:
        """What the camera sees now with the tracked point drawn in, BGR; drawn on demand."""
        camera, runway = self._scenario.camera, self._scenario.runway
        state = np.array(self.evaluate("seen_state", context))
        parameters = camera_parameters(camera, self._scenario.seed)
        image = draw_picture(
            state[:3],
            state[6:9],
            parameters[4:7],
            parameters[7:10],
            parameters[:4],
            np.array([runway.heading_radians, runway.width, runway.length]),
            (0, 0),
            (int(camera.rows), int(camera.columns)),
            _GRAIN,
            stream_key(self._scenario.seed, "runway_pixel_camera.grain"),
            round(context.get_time() / SLOW_PERIOD),
        )
        distance = float(np.hypot(state[0], state[1]))
        tracked = PICTURE(self.evaluate("picture", context))
        point = (tracked.u, tracked.v) if tracked.valid > 0.0 else None
        return [("camera", draw_tracked_point(image, point, f"{distance:.0f} m to go"))]


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
_WITH_RUNWAY = ("filter", "flight_controller")
# what goes into the log; a measurement that comes faster than it is recorded is thinned out
RECORDED = {
    "state": FIXED_WING_STATE,
    "estimate": NAVIGATION_ESTIMATE,
    "phase": PHASE_STATUS,
    "guidance": GUIDANCE,
    "command": FIXED_WING_COMMAND,
    "end": END,
    "fix": FIX,
    "antenna": ANTENNA,
    "picture": PICTURE,
    "laser": LASER_HEIGHT,
}
_GRAIN = 2.0  # grey levels, one sigma, of the pictures in the report
