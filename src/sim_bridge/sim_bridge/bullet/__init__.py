# SPDX-License-Identifier: Apache-2.0
"""The simulated robot: PyBullet, drives, joint friction, sensors and obstacles."""
