# SPDX-License-Identifier: Apache-2.0
"""Exact joint acceleration bounds that keep position and velocity limits for ever."""
