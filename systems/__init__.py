"""Everything on board: sensors, estimators, supervisors, controllers.

Each is a Drake `LeafSystem` with its configuration dataclass beside it. What
travels between them lies in `systems.signals`, pixels to pose in
`systems.vision`. The world itself (what moves and what can be seen) is not
here but in `plants`; wiring is not here but in `diagrams`.
"""
