"""The world: what moves (vehicles, wind, pads, terrain) and what can be seen.

Nothing on board is here; a plant knows neither sensors nor estimators.
"""
