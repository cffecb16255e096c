"""Pixels to pose: pure functions of arrays, without Drake.

Rendering and detection live side by side so that each can be checked against
the other. Systems that own a camera are in `systems.sensors`.
"""
