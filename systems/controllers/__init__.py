"""Controllers: from setpoint and estimate to actuator commands."""
