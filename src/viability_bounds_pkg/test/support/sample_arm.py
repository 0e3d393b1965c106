# SPDX-License-Identifier: Apache-2.0
"""Pinocchio's sample arm with limits, for tests of what is said of an arm's states."""

import numpy as np
import pinocchio as pin

MODEL = pin.buildSampleModelManipulator()
N = MODEL.nv
MODEL.velocityLimit[:] = 2.0
TAU_MAX = np.full(N, 50.0)
NONE = np.zeros(N)
