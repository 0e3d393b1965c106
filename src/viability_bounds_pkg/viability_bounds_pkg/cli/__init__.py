# SPDX-License-Identifier: Apache-2.0
"""Command line tools, and what they have in common."""

from viability_bounds_pkg.cli.command_line import Parser, positive, run_tool

__all__ = ["Parser", "positive", "run_tool"]
