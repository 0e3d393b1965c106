# SPDX-License-Identifier: Apache-2.0
"""Joint friction: compensation and identification."""
