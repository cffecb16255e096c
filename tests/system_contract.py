"""What every system's docstring promises, compared with the system itself.

A test of a block says::

    def test_topology():
        assert_matches_docstring(Barometer(BarometerConfig(), seed=1))

The docstring holds a `.. pydrake_system::` block with the ports and a table with one
row a port, ``| `body` (optional) | `BODY_STATE` | the state of the body |``. Where the
second column names a layout of `systems.signals.measurement`, its size must be the port's.
"""

import inspect
import re
import textwrap
from dataclasses import dataclass

from pydrake.systems.framework import InputPort, LeafSystem, OutputPort, PortDataType, System
from ruamel.yaml import YAML

from systems.signals import measurement

_OPTIONAL = re.compile(r"\s*\(optional\)\s*$")


@dataclass(frozen=True)
class Contract:
    """The ports that a docstring promises.

    Attributes
    ----------
    name : str
        The class's name as the docstring gives it.
    inputs, outputs : tuple of str
        Port names, in order.
    optional : frozenset of str
        The input ports that are marked "(optional)" in the block or in the table.
    layouts : dict of str to str
        The layout column of the port table, by port; ports without a row are absent.
    """

    name: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    optional: frozenset[str]
    layouts: dict[str, str]


def docstring_contract(system_class: type) -> Contract:
    """The contract in the docstring of `system_class`; raises `ValueError` without one."""
    lines = inspect.cleandoc(system_class.__doc__ or "").splitlines()
    starts = [i for i, line in enumerate(lines) if line.strip() == ".. pydrake_system::"]
    if len(starts) != 1:
        raise ValueError(f"{system_class.__name__} has {len(starts)} `.. pydrake_system::` blocks")
    body = []
    for line in lines[starts[0] + 1 :]:
        if line.strip() and not line.startswith(" "):
            break
        body.append(line)
    block = YAML(typ="safe").load(textwrap.dedent("\n".join(body)))
    inputs = [str(port) for port in block.get("input_ports") or ()]
    outputs = [str(port) for port in block.get("output_ports") or ()]
    optional = {_OPTIONAL.sub("", port) for port in inputs if _OPTIONAL.search(port)}
    inputs = [_OPTIONAL.sub("", port) for port in inputs]

    layouts = {}
    for line in lines:
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
        port = _OPTIONAL.sub("", cells[0]).strip("`")
        if len(cells) >= 3 and port in {*inputs, *outputs}:
            layouts[port] = cells[1].strip("`")
            if _OPTIONAL.search(cells[0]):
                optional.add(port)
    return Contract(block["name"], tuple(inputs), tuple(outputs), frozenset(optional), layouts)


def assert_matches_docstring(system: System) -> Contract:
    """Assert that the real ports of `system` are those in its class's docstring.

    Compares the class's name, the names and the order of the ports, that each port
    has a row in the port table, and the sizes of the ports whose layout is named.
    """
    contract = docstring_contract(type(system))
    assert contract.name == type(system).__name__
    inputs = [system.get_input_port(i) for i in range(system.num_input_ports())]
    outputs = [system.get_output_port(i) for i in range(system.num_output_ports())]
    assert tuple(port.get_name() for port in inputs) == contract.inputs
    assert tuple(port.get_name() for port in outputs) == contract.outputs
    ports: list[InputPort | OutputPort] = [*inputs, *outputs]
    for port in ports:
        name = port.get_name()
        assert name in contract.layouts, f"port {name} has no row in the port table"
        layout = getattr(measurement, contract.layouts[name], None)
        if isinstance(layout, measurement.Layout):
            assert port.get_data_type() == PortDataType.kVectorValued
            assert port.size() == layout.size, f"port {name} is not a {layout.name}"
    return contract


def periodic_update(system: LeafSystem) -> tuple[float, float]:
    """Period and offset (s) of the one periodic discrete update of `system`."""
    timing = system.GetUniquePeriodicDiscreteUpdateAttribute()
    assert timing is not None, f"{system.get_name()} has no unique periodic discrete update"
    return timing.period_sec(), timing.offset_sec()
