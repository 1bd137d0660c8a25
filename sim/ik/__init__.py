"""Inverse kinematics with a verdict."""
