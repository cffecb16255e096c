"""The world as one named diagram: multirotor, wind and pad."""

from pydrake.systems.framework import Diagram, DiagramBuilder

from diagrams.blocks import Blocks


def world(blocks: Blocks) -> Diagram:
    """What moves and what can be seen.

    Exports the inputs `rotor_commands`, `supervisor` and the outputs `body`, `rotor_speeds`,
    `wind`, `pad`.
    """
    builder = DiagramBuilder()
    multirotor = blocks.add(builder, "vehicle", "multirotor")
    wind = blocks.add(builder, "wind", "wind")
    pad = blocks.add(builder, "pad", "pad")
    body = multirotor.GetOutputPort("body")
    builder.Connect(wind.GetOutputPort("wind"), multirotor.GetInputPort("wind"))
    builder.Connect(pad.GetOutputPort("pad"), multirotor.GetInputPort("pad"))
    builder.Connect(body, wind.GetInputPort("body"))
    builder.ExportInput(multirotor.GetInputPort("rotor_commands"), "rotor_commands")
    builder.ExportInput(pad.GetInputPort("supervisor"), "supervisor")
    builder.ExportOutput(body, "body")
    builder.ExportOutput(multirotor.GetOutputPort("rotor_speeds"), "rotor_speeds")
    builder.ExportOutput(wind.GetOutputPort("wind"), "wind")
    builder.ExportOutput(pad.GetOutputPort("pad"), "pad")
    diagram = builder.Build()
    diagram.set_name("world")
    return diagram
