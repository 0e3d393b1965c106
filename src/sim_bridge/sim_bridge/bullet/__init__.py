"""The simulated robot: PyBullet, drives, joint friction, sensors and obstacles."""
