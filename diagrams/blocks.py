"""The blocks of a diagram by their place in the scenario, so that it can be used again."""

from typing import Any

from pydrake.systems.framework import DiagramBuilder, System

from systems.configuration import StructureChangedError
from systems.signals.noise import derived_seed


def at_path(scenario: Any, path: str) -> Any:
    """The part of a scenario at a dotted path; None if a part on the way is None."""
    for name in path.split("."):
        if scenario is None:
            return None
        scenario = getattr(scenario, name)
    return scenario


class Blocks:
    """Adds blocks to builders and remembers where their configurations came from.

    Each block draws its noise from a seed of its own, derived from the scenario's seed
    and the block's path. So variants of a scenario share the noise of the blocks they share.

    Parameters
    ----------
    scenario : dataclass
        The scenario that is being built; has a field `seed`.
    """

    def __init__(self, scenario: Any):
        self.scenario = scenario
        self.systems: dict[str, System] = {}
        self._kinds: dict[str, type] = {}

    def add(self, builder: DiagramBuilder, path: str, name: str, **options: Any) -> Any:
        """Add the block configured at `path`, called `name`; None where there is none.

        Parameters
        ----------
        builder : DiagramBuilder
            Of the diagram that shall own the block.
        path : str
            Dotted path of its configuration in the scenario.
        name : str
            The name of the system in the diagram.
        **options
            Passed on to the configuration's `add_to`.
        """
        config = at_path(self.scenario, path)
        self._kinds[path] = type(config)
        if config is None:
            return None
        self.systems[path] = config.add_to(builder, name, self.seed_of(path), **options)
        return self.systems[path]

    def keep(self, path: str, system: System) -> None:
        """Remember a system that was built elsewhere from the configuration at `path`."""
        self._kinds[path] = type(at_path(self.scenario, path))
        self.systems[path] = system

    def configure(self, scenario: Any) -> None:
        """Give every block its configuration and seed from `scenario`.

        Raises
        ------
        StructureChangedError
            If the scenario needs another diagram; some blocks may then have been
            configured, so configure again before the next run.
        """
        for path, kind in self._kinds.items():
            config = at_path(scenario, path)
            if type(config) is not kind:
                raise StructureChangedError(
                    f"{path} was built from a {kind.__name__} and cannot become a "
                    f"{type(config).__name__}: build a new diagram"
                )
        self.scenario = scenario
        for path, system in self.systems.items():
            system.configure(at_path(scenario, path), self.seed_of(path))

    def seed_of(self, path: str) -> int:
        """The seed of the block configured at `path`."""
        return derived_seed(self.scenario.seed, path)
