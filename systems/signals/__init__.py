"""What travels between the blocks: measurement layouts, noise, delay line, fault injector.

The lowest floor of the laboratory: nothing here knows of a vehicle or a scenario.
"""
