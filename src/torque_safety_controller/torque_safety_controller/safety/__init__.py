# SPDX-License-Identifier: Apache-2.0
"""The last checks of a torque, the disturbance observer, modes and handover."""
