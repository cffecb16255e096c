"""Navigation: one EKF2, or several on inertial sensors of their own behind a selector."""

from pydrake.systems.framework import Diagram, DiagramBuilder, System

from diagrams.blocks import Blocks, at_path
from systems.estimators.ekf2.ekf2 import Ekf2Config
from systems.estimators.ekf2_selector import Ekf2SelectorConfig

IMUS = ("imu", "imu_2", "imu_3")  # inputs of the instances, in their order
SHARED = (
    "gnss",
    "barometer",
    "magnetometer",
    "range_finder",
    "external_vision",
    "vehicle_status",
)


class RedundantNavigation(Diagram):
    """EKF2 instances that differ in their inertial sensor, and the selector behind them.

    .. pydrake_system::
        name: RedundantNavigation
        input_ports:
        - imu
        - imu_2
        - imu_3
        - gnss (optional)
        - barometer (optional)
        - magnetometer (optional)
        - range_finder (optional)
        - external_vision (optional)
        - vehicle_status (optional)
        output_ports:
        - estimate
        - instance
        - selection

    | port | layout | meaning |
    |---|---|---|
    | `imu` | `INERTIAL` | of instance 0 |
    | `imu_2` | `INERTIAL` | of instance 1 |
    | `imu_3` | `INERTIAL` | of instance 2; not there with two instances |
    | `gnss` (optional) | `GNSS` | shared by all, as the next ones; unconnected: no GNSS |
    | `barometer` (optional) | `BAROMETER` | unconnected: no barometer |
    | `magnetometer` (optional) | `MAGNETOMETER` | unconnected: the heading waits for GNSS |
    | `range_finder` (optional) | `RANGE_FINDER` | unconnected: the ground is where it took off |
    | `external_vision` (optional) | `EXTERNAL_VISION` | unconnected: no vision |
    | `vehicle_status` (optional) | `VEHICLE_STATUS` | unconnected: in the air |
    | `estimate` | `VEHICLE_ESTIMATE` | of the selected instance, a change being a reset |
    | `instance` | (2,) | its number, and the time (s) of the last change |
    | `selection` | `selection_layout` | the selector's ratios, errors and jumps |

    Parameters
    ----------
    config : Ekf2Config
        Of every instance.
    selector : Ekf2SelectorConfig
        With as many instances as there are inertial sensors.
    seed : int
        Of nothing; for uniformity.
    """

    def __init__(self, config: Ekf2Config, selector: Ekf2SelectorConfig, seed: int = 0):
        super().__init__()
        builder = DiagramBuilder()
        self.instances = [
            config.add_to(builder, f"EKF2 {i}", seed) for i in range(selector.instances)
        ]
        self.selector = selector.add_to(builder, "selector", seed)
        for i, instance in enumerate(self.instances):
            imu = builder.ExportInput(instance.GetInputPort("imu"), IMUS[i])
            builder.ConnectInput(imu, self.selector.GetInputPort(f"imu_{i}"))
            for output in ("estimate", "innovations", "status"):
                builder.Connect(
                    instance.GetOutputPort(output), self.selector.GetInputPort(f"{output}_{i}")
                )
        for name in SHARED:
            shared = builder.ExportInput(self.instances[0].GetInputPort(name), name)
            for instance in self.instances[1:]:
                builder.ConnectInput(shared, instance.GetInputPort(name))
        for name in ("estimate", "instance", "selection"):
            builder.ExportOutput(self.selector.GetOutputPort(name), name)
        builder.BuildInto(self)

    def configure(self, config: Ekf2Config, seed: int = 0) -> None:
        """Another configuration for all instances; raises `StructureChangedError` as they do."""
        for instance in self.instances:
            instance.configure(config, seed)


def add_navigation(blocks: Blocks, builder: DiagramBuilder) -> System:
    """Add the scenario's navigation, called "navigation".

    Parameters
    ----------
    blocks : Blocks
        With `navigation` and `selector` in its scenario.
    builder : DiagramBuilder

    Returns
    -------
    System
        An `Ekf2`, or a `RedundantNavigation` where the scenario has a selector.

    Raises
    ------
    ValueError
        If the selector's instances are not as many as the inertial sensors.
    """
    scenario = blocks.scenario
    if scenario.selector is None:
        blocks.add(builder, "selector", "selector")
        return blocks.add(builder, "navigation", "navigation")
    sensors = [name for name in IMUS if at_path(scenario, f"sensors.{name}") is not None]
    if sensors != list(IMUS[: scenario.selector.instances]):
        raise ValueError(
            f"selector.instances is {scenario.selector.instances}, "
            f"but the inertial sensors are {', '.join(sensors)}"
        )
    bank = RedundantNavigation(scenario.navigation, scenario.selector, blocks.seed_of("navigation"))
    builder.AddNamedSystem("navigation", bank)
    blocks.keep("navigation", bank)
    blocks.keep("selector", bank.selector)
    return bank
