# SPDX-License-Identifier: Apache-2.0
"""What users write, checked before it is used: YAML, parameter files, names, robots."""
