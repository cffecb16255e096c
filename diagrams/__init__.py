"""Only wiring: the scenario's dataclasses, builders of named sub-diagrams, graph export.

No equation and no state lives here.
"""
