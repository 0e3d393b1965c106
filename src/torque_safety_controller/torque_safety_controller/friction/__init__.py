# SPDX-License-Identifier: Apache-2.0
"""Joint friction: its model and identification."""
