# SPDX-License-Identifier: Apache-2.0
"""Command line tools, and what they have in common."""
