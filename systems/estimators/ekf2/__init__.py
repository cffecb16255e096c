"""PX4's EKF2: delayed horizon, ring buffers, sequential fusion, output predictor."""
