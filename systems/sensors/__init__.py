"""Sensors: one file each, a `LeafSystem` that turns the state of the world into a measurement.

Rates, noise and biases are here; latency is an explicit `DelayLine` behind the
sensor and a fault an explicit `FaultInjector`, both in `systems.signals`.
"""
