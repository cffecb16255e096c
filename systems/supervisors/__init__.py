"""Supervisors: discrete-state systems whose transition table is data; one file a routine.

`state_machine` holds the table and runs it, `mission` the part common to every flight (arm,
climb, fly the square, touch down), each routine file what happens between the end of the
mission and the ground, and `landing_supervisor` the `LeafSystem` that puts them together.
Controllers that follow the setpoints are not here.
"""
