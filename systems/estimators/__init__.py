"""Estimators: PX4's EKF2 for the vehicle (`ekf2`) and one file for each landing-target estimator.

They see measurements only, never the state of the world.
"""
