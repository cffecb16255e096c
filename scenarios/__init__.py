"""Scenarios as commented YAML: one for each published experiment and one default."""
