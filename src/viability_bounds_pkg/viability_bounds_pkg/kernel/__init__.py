# SPDX-License-Identifier: Apache-2.0
"""The viability kernel: one joint's bounds, in continuous and in discrete time."""
