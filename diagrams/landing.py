"""The whole laboratory for a vertical landing: world, sensors, navigation, guidance, control."""

import numpy as np
from pydrake.systems.framework import Context, DiagramBuilder, OutputPort

from diagrams.blocks import Blocks
from diagrams.navigation import RedundantNavigation, add_navigation
from diagrams.recording import Recording
from diagrams.scenario import MultirotorLanding, settled
from diagrams.sensors import sensors
from diagrams.svgs import RECORDED
from diagrams.vehicle import world
from plants.touchdown import REASONS
from systems.estimators.ekf2_selector import selection_layout
from systems.schedule import PLANT_PERIOD
from systems.signals.measurement import (
    BAROMETER,
    BODY_STATE,
    EXTERNAL_VISION,
    GNSS,
    INERTIAL,
    INFRARED,
    MAGNETOMETER,
    MARKER,
    PAD_STATE,
    RANGE_FINDER,
    SETPOINT,
    SUPERVISOR_STATUS,
    SVGS,
    TARGET_ESTIMATE,
    TARGET_MEASUREMENT,
    TOUCHDOWN,
    VEHICLE_ESTIMATE,
    Layout,
)
from systems.vision.drawing import draw_infrared_detection, draw_marker_detection
from systems.vision.svgs_drawing import draw_svgs_detection

MEASUREMENTS = (
    "imu",
    "imu_2",
    "imu_3",
    "gnss",
    "barometer",
    "magnetometer",
    "range_finder",
    "marker",
    "infrared",
    "svgs",
    "pad_gnss",
)


PICTURE_WIDTH = 640  # px, of the drawings of what the cameras saw


class LandingDiagram:
    """The diagram of a `MultirotorLanding` and the names of what is in it.

    Sub-diagrams `world`, `sensors` and `landing target` and the systems `navigation`,
    `guidance`, `control` and `observer` are connected by name; the input
    `fault_command` is exported for faults injected at run time.

    Parameters
    ----------
    scenario : MultirotorLanding
        What to build.

    Attributes
    ----------
    diagram : Diagram
        The root.
    ports : dict
        Output ports by the name they have in the log.
    recording : Recording
        What is recorded of them.
    """

    def __init__(self, scenario: MultirotorLanding):
        scenario = settled(scenario)
        self.blocks = Blocks(scenario)
        builder = DiagramBuilder()
        self.world = builder.AddSystem(world(self.blocks))
        self.sensors = builder.AddSystem(sensors(self.blocks))
        self.navigation = add_navigation(self.blocks, builder)
        self.target = self.blocks.add(builder, "landing_target", "landing target")
        self.guidance = self.blocks.add(builder, "guidance", "guidance")
        self.control = self.blocks.add(builder, "control", "control")
        self.observer = self.blocks.add(builder, "touchdown", "observer")
        self.ports = self._named_ports()
        recorded = {name: layout for name, layout in RECORDED.items() if name in self.ports}
        self.recorder = self.blocks.add(builder, "data_recorder", "data recorder", ports=recorded)
        self._connect(builder)
        self.recording = self._record(builder, scenario)
        self.diagram = builder.Build()
        self.diagram.set_name(scenario.kind)

    def configure(self, scenario: MultirotorLanding) -> None:
        """Take over another scenario of the same structure; raises `StructureChangedError`."""
        self.blocks.configure(settled(scenario))

    def evaluate(self, name: str, context: Context) -> np.ndarray:
        """The value of the port called `name` in the root context."""
        port = self.ports[name]
        return port.Eval(port.get_system().GetMyContextFromRoot(context))

    def reason(self, context: Context) -> str:
        """Why the run is over, in words."""
        code = int(TOUCHDOWN(self.evaluate("touchdown", context)).reason)
        return REASONS[code]

    def state(self, context: Context) -> str:
        """The supervisor's state, in words."""
        return self.guidance.state_name(self.evaluate("supervisor", context)).replace("_", " ")

    def is_landing(self, context: Context) -> bool:
        """Whether the landing routine has taken over."""
        return bool(SUPERVISOR_STATUS(self.evaluate("supervisor", context)).landing_started >= 0.0)

    def state_names(self) -> list[str]:
        """The names of the supervisor's states, by index."""
        return [state.name for state in self.guidance.machine.table.states]

    def states_dot(self) -> str:
        """The supervisor's transition table as DOT text."""
        return self.guidance.states_dot()

    def camera_pictures(self, context: Context) -> list[tuple[str, np.ndarray]]:
        """What each camera saw last, with its measurement drawn in, BGR; rendered on demand."""
        pictures = []
        for name, draw in (
            ("marker", draw_marker_detection),
            ("infrared", draw_infrared_detection),
            ("svgs", draw_svgs_detection),
        ):
            camera = self.blocks.systems.get(f"sensors.{name}_camera.sensor")
            if camera is None:
                continue
            own = camera.GetMyContextFromRoot(context)
            image = camera.GetOutputPort("image").Eval(own)
            measurement = camera.GetOutputPort("measurement").Eval(own)
            picture = draw(image, measurement, camera.camera, PICTURE_WIDTH)
            pictures.append((f"{name} camera", picture))
        return pictures

    def _named_ports(self) -> dict[str, OutputPort]:
        ports = {name: self.world.GetOutputPort(name)
                 for name in ("body", "rotor_speeds", "wind", "pad")}  # fmt: skip
        for name in MEASUREMENTS:
            if self.sensors.HasOutputPort(name):
                ports[name] = self.sensors.GetOutputPort(name)
        ports["estimate"] = self.navigation.GetOutputPort("estimate")
        if isinstance(self.navigation, RedundantNavigation):
            for name in ("instance", "selection"):
                ports[name] = self.navigation.GetOutputPort(name)
        if self.target is not None:
            ports["target_measurement"] = self.target.GetOutputPort("measurement")
            ports["target"] = self.target.GetOutputPort("target")
            if self.target.HasOutputPort("external_vision"):
                ports["external_vision"] = self.target.GetOutputPort("external_vision")
        ports["setpoint"] = self.guidance.GetOutputPort("setpoint")
        ports["supervisor"] = self.guidance.GetOutputPort("status")
        ports["vehicle_status"] = self.guidance.GetOutputPort("vehicle_status")
        ports["rotor_commands"] = self.control.GetOutputPort("rotor_commands")
        ports["touchdown"] = self.observer.GetOutputPort("touchdown")
        return ports

    def _connect(self, builder: DiagramBuilder) -> None:
        """Connect every input to the output of the same name."""
        for system in (
            self.world,
            self.sensors,
            self.navigation,
            self.target,
            self.guidance,
            self.control,
            self.observer,
            self.recorder,
        ):
            if system is None:
                continue
            for index in range(system.num_input_ports()):
                port = system.get_input_port(index)
                if port.get_name() in self.ports:
                    builder.Connect(self.ports[port.get_name()], port)
        if self.sensors.HasInputPort("fault_command"):
            builder.ExportInput(self.sensors.GetInputPort("fault_command"), "fault_command")

    def _record(self, builder: DiagramBuilder, scenario: MultirotorLanding) -> Recording:
        recording = Recording()
        rotors = range(scenario.vehicle.rotor_count)
        slow = scenario.recording.period
        ports: dict[str, tuple[Layout | list[str], float]] = {
            "body": (BODY_STATE, slow),
            "wind": (["v_W_x", "v_W_y", "v_W_z"], slow),
            "pad": (PAD_STATE, slow),
            "estimate": (VEHICLE_ESTIMATE, slow),
            "instance": (["selected", "changed"], slow),
            "target": (TARGET_ESTIMATE, slow),
            "setpoint": (SETPOINT, slow),
            "supervisor": (SUPERVISOR_STATUS, slow),
            "rotor_commands": ([f"rotor_{i + 1}" for i in rotors], slow),
            "touchdown": (TOUCHDOWN, slow),
            "gnss": (GNSS, slow),
            "pad_gnss": (GNSS, slow),
            "barometer": (BAROMETER, slow),
            "magnetometer": (MAGNETOMETER, slow),
            "marker": (MARKER, slow),
            "infrared": (INFRARED, 0.5 * slow),
            "svgs": (SVGS, slow),
            "external_vision": (EXTERNAL_VISION, 0.5 * slow),
            "range_finder": (RANGE_FINDER, slow),
            "target_measurement": (TARGET_MEASUREMENT, 0.5 * slow),
        }
        if scenario.selector is not None:
            ports["selection"] = (selection_layout(scenario.selector.instances), slow)
        if scenario.recording.imu:
            ports["imu"] = (INERTIAL, PLANT_PERIOD)
        for name, (layout, period) in ports.items():
            if name in self.ports:
                recording.add(self.ports[name], name, layout, period)
        recording.connect(builder)
        return recording
