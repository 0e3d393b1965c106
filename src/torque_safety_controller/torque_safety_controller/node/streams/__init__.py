# SPDX-License-Identifier: Apache-2.0
"""What the controller node hears and answers each control period: states, limits, commands."""
